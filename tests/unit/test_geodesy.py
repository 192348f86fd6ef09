"""Geodesy against vectors on the sphere: distances and bearings that need no projection."""

from __future__ import annotations

import numpy as np
import pytest

from offboard.model.geodesy import EARTH_RADIUS_M, Geodetic, position_ned_m


def unit(place: Geodetic) -> np.ndarray:
    latitude, longitude = np.radians(place[:2])
    level = np.cos(latitude)
    return np.array([level * np.cos(longitude), level * np.sin(longitude), np.sin(latitude)])


@pytest.mark.parametrize("origin", [Geodetic(-35.36, 149.17, 584.0), Geodetic(78, -179.99)])
@pytest.mark.parametrize(("north_deg", "east_deg"), [(0, -2e-5), (-0.1, 0.05)])
def test_distance_and_bearing_are_the_sphere_s(
    origin: Geodetic, north_deg: float, east_deg: float
) -> None:
    place = Geodetic(origin[0] + north_deg, origin[1] + east_deg, 3.0)
    here, there = unit(origin), unit(place)
    longitude = np.radians(origin[1])
    east_axis = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    north_axis = np.cross(here, east_axis)
    along = np.array([there @ north_axis, there @ east_axis])
    distance_m = EARTH_RADIUS_M * np.arctan2(np.linalg.norm(along), there @ here)
    expected = distance_m * along / np.linalg.norm(along)
    north, east, down = position_ned_m(place, origin)
    assert (north, east) == pytest.approx(expected, abs=1e-6)
    assert down == origin[2] - 3.0
