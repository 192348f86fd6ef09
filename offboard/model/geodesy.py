"""Latitude, longitude and altitude <-> metres in the local NED frame of an origin.

The azimuthal equidistant projection on a sphere (J. P. Snyder, Map Projections, 1987, section 25):
distances from the origin are true, as in the local frames of PX4 and ArduPilot.
"""

from __future__ import annotations

import math
from typing import NamedTuple

EARTH_RADIUS_M = 6_371_000.0
Triple = tuple[float, float, float]


class Geodetic(NamedTuple):
    """A point: degrees, and metres above mean sea level."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float = 0.0


def position_ned_m(place: Geodetic, origin: Geodetic) -> Triple:
    """North, east and down of `place` relative to `origin`, m."""
    latitude, reference = math.radians(place.latitude_deg), math.radians(origin.latitude_deg)
    turn = math.radians(place.longitude_deg - origin.longitude_deg)
    sine, cosine = math.sin(latitude), math.cos(latitude)
    north = math.cos(reference) * sine - math.sin(reference) * cosine * math.cos(turn)
    east = cosine * math.sin(turn)
    chord = math.hypot(north, east)
    scale = EARTH_RADIUS_M * (math.asin(min(chord, 1.0)) / chord if chord > 0.0 else 1.0)
    return scale * north, scale * east, origin.altitude_m - place.altitude_m


def origin_of(place: Geodetic, known_ned_m: Triple) -> Geodetic:
    """The origin relative to which `place` is at `known_ned_m`."""
    metres = math.radians(1.0) * EARTH_RADIUS_M
    shrink = max(math.cos(math.radians(place.latitude_deg)), 1e-6)
    latitude, longitude, altitude = place
    altitude += known_ned_m[2]
    for _ in range(3):  # each pass leaves a millionth of the error for every few metres
        north, east, _down = position_ned_m(place, Geodetic(latitude, longitude, altitude))
        latitude += (north - known_ned_m[0]) / metres
        longitude += (east - known_ned_m[1]) / (metres * shrink)
    return Geodetic(latitude, longitude, altitude)
