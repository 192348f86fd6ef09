"""Latitude and longitude to metres round the origin, on a sphere. Knows no vehicle."""

from __future__ import annotations

import math

EARTH_RADIUS_M = 6_371_000.0
Origin = tuple[float, float, float]  # latitude, longitude deg, AMSL m


def to_metres(origin: Origin, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """North and east, m, of a point near the origin."""
    latitude, longitude, _ = origin
    north_m = math.radians(latitude_deg - latitude) * EARTH_RADIUS_M
    shrink = math.cos(math.radians(latitude))
    return north_m, math.radians(longitude_deg - longitude) * EARTH_RADIUS_M * shrink
