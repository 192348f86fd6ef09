"""Rotations against SciPy, random ones and at singularities; positions on the sphere."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from offboard.model.frames import (
    euler_from_quaternion,
    heading_from_quaternion,
    quaternion_from_euler,
    quaternion_from_thrust_direction,
    rotation_from_quaternion,
    thrust_direction_from_quaternion,
    wrap_pi,
)
from offboard.model.geodesy import EARTH_RADIUS_M, Geodetic, position_ned_m

Array = NDArray[np.float64]

RANDOM = Rotation.random(500, random_state=17)
QUATERNIONS = RANDOM.as_quat(scalar_first=True)

angles = st.floats(-math.pi, math.pi)


def scipy_rotation(quaternion: Array) -> Rotation:
    return Rotation.from_quat(quaternion, scalar_first=True)


def angle_between(left: Array, right: Array) -> float:
    """The largest rotation angle between two sets of quaternions."""
    return float(np.max((scipy_rotation(left).inv() * scipy_rotation(right)).magnitude()))


def test_euler_angles_survive_gimbal_lock() -> None:
    for nose, short_of_it in itertools.product((-1.0, 1.0), (0.0, 1e-9, 1e-16)):
        quaternion = quaternion_from_euler(0.4, nose * (math.pi / 2 - short_of_it), -1.1)
        again = quaternion_from_euler(*euler_from_quaternion(quaternion))
        assert angle_between(quaternion, again) < 1e-13


def test_conversions_agree_with_scipy_for_single_values_and_arrays() -> None:
    """One quaternion and an array (5, 100) are converted alike; the heading is that of the nose."""
    nose, many = RANDOM.apply([1.0, 0.0, 0.0]), QUATERNIONS.reshape(5, 100, 4)
    euler = RANDOM.as_euler("ZYX")[:, ::-1]
    for convert, expected in (
        (euler_from_quaternion, euler),
        (rotation_from_quaternion, RANDOM.as_matrix()),
        (thrust_direction_from_quaternion, RANDOM.apply([0.0, 0.0, 1.0])),
        (heading_from_quaternion, np.arctan2(nose[:, 1], nose[:, 0])),
    ):
        reshaped = expected.reshape(5, 100, *expected.shape[1:])
        assert_allclose(convert(many), reshaped, atol=1e-13)
        assert_allclose(convert(many[2, 57]), reshaped[2, 57], atol=1e-13)
    for angles_rad, quaternion in zip(euler, QUATERNIONS, strict=True):
        assert angle_between(quaternion_from_euler(*angles_rad), quaternion) < 1e-13
    direction, heading = thrust_direction_from_quaternion(many), heading_from_quaternion(many)
    batch = quaternion_from_thrust_direction(direction, heading)
    single = quaternion_from_thrust_direction(direction[2, 57], heading[2, 57])
    assert_allclose(batch[2, 57], single, rtol=0, atol=1e-15)


@given(angles, st.floats(0, math.pi), angles, st.floats(0.01, 100))
def test_attitude_has_the_given_thrust_direction_and_heading(
    azimuth: float, tilt: float, heading: float, length: float
) -> None:
    """For any b, also upside down, the body's z axis is b and the nose points along the heading."""
    direction = np.array(
        [math.sin(tilt) * math.cos(azimuth), math.sin(tilt) * math.sin(azimuth), math.cos(tilt)]
    )
    attitude = scipy_rotation(quaternion_from_thrust_direction(length * direction, heading))
    assert_allclose(attitude.apply([0, 0, 1]), direction, atol=1e-14)
    nose = attitude.apply([1, 0, 0])
    across = nose[1] * math.cos(heading) - nose[0] * math.sin(heading)
    ahead = nose[0] * math.cos(heading) + nose[1] * math.sin(heading)
    assert abs(across) < 1e-14
    assert ahead > -1e-14


@given(st.floats(-1e6, 1e6))
def test_wrap_pi_keeps_the_angle_within_pi(angle: float) -> None:
    wrapped = wrap_pi(angle)
    assert -math.pi <= wrapped <= math.pi
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    apart = math.remainder(wrap_pi(np.array([angle]))[0] - wrapped, math.tau)
    assert apart == pytest.approx(0.0, abs=1e-9)


# --- geodesy --------------------------------------------------------------------------------------


def unit(place: Geodetic) -> np.ndarray:
    latitude, longitude = np.radians(place[:2])
    level = np.cos(latitude)
    return np.array([level * np.cos(longitude), level * np.sin(longitude), np.sin(latitude)])


@pytest.mark.parametrize("origin", [Geodetic(-35.36, 149.17, 584.0), Geodetic(78, -179.99)])
@pytest.mark.parametrize(("north_deg", "east_deg"), [(0, -2e-5), (-0.1, 0.05)])
def test_distance_and_bearing_agree_with_the_sphere(
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
