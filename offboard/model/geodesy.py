"""Latitude, longitude and altitude <-> metres in the local NED frame of an origin.

Uses the azimuthal equidistant projection on a sphere (J. P. Snyder, Map Projections, 1987, section
25): distances from the origin are true, as in PX4's local frame; ArduPilot's are 0.11 % longer.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

EARTH_RADIUS_M = 6_371_000.0
Triple = tuple[float, float, float]


class Geodetic(NamedTuple):
    """A point: latitude and longitude in degrees, altitude in metres above mean sea level."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float = 0.0


def position_ned_m(places: ArrayLike, origin: Geodetic) -> NDArray[np.float64]:
    """Return north, east and down (..., 3) in m, relative to `origin`, of `places` (..., 3), which
    are in the units of `Geodetic`."""
    latitude_deg, longitude_deg, altitude_m = np.moveaxis(np.asarray(places, np.float64), -1, 0)
    latitude, reference = np.radians(latitude_deg), math.radians(origin.latitude_deg)
    turn = np.radians(longitude_deg - origin.longitude_deg)
    sine, cosine = np.sin(latitude), np.cos(latitude)
    north = math.cos(reference) * sine - math.sin(reference) * cosine * np.cos(turn)
    east = cosine * np.sin(turn)
    chord = np.minimum(np.hypot(north, east), 1.0)
    scale = EARTH_RADIUS_M / np.sinc(np.arcsin(chord) / math.pi)  # angle over its sine
    return np.stack((scale * north, scale * east, origin.altitude_m - altitude_m), axis=-1)


def origin_of(place: Geodetic, known_ned_m: Triple) -> Geodetic:
    """Return the origin of the local NED frame in which `place` is at `known_ned_m`."""
    metres = math.radians(1.0) * EARTH_RADIUS_M
    shrink = max(math.cos(math.radians(place.latitude_deg)), 1e-6)
    latitude, longitude, altitude = place
    altitude += known_ned_m[2]
    for _ in range(3):  # a pass leaves 1e-6 of the error per few metres from the origin
        found = position_ned_m(place, Geodetic(latitude, longitude, altitude))
        north, east, _down = found.tolist()
        latitude += (north - known_ned_m[0]) / metres
        longitude += (east - known_ned_m[1]) / (metres * shrink)
    return Geodetic(latitude, longitude, altitude)
