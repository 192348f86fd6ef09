"""Rotations against SciPy's, on random ones and in the awkward places."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
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

Array = NDArray[np.float64]

RANDOM = Rotation.random(500, random_state=17)
QUATERNIONS = RANDOM.as_quat(scalar_first=True)

angles = st.floats(-math.pi, math.pi)
any_float = st.floats() | st.sampled_from([math.nan, math.inf, -math.inf, 0.0, -0.0])


def scipy_rotation(quaternion: Array) -> Rotation:
    return Rotation.from_quat(quaternion, scalar_first=True)


def angle_between(left: Array, right: Array) -> float:
    """The largest rotation angle between two sets of quaternions."""
    return float(np.max((scipy_rotation(left).inv() * scipy_rotation(right)).magnitude()))


@given(angles, angles, angles)
def test_quaternion_from_euler_is_scipys(phi: float, theta: float, psi: float) -> None:
    expected = Rotation.from_euler("ZYX", [psi, theta, phi]).as_quat(scalar_first=True)
    assert angle_between(quaternion_from_euler(phi, theta, psi), expected) < 1e-14


def test_euler_from_quaternion_is_scipys() -> None:
    assert_allclose(euler_from_quaternion(QUATERNIONS), RANDOM.as_euler("ZYX")[:, ::-1], atol=1e-13)


@given(angles, st.floats(-math.pi / 2, math.pi / 2), angles)
def test_euler_angles_describe_the_rotation(phi: float, theta: float, psi: float) -> None:
    quaternion = quaternion_from_euler(phi, theta, psi)
    again = quaternion_from_euler(*euler_from_quaternion(quaternion))
    assert angle_between(quaternion, again) < 1e-13


@pytest.mark.parametrize("nose", [-1.0, 1.0])
@pytest.mark.parametrize("short_of_it", [0.0, 1e-9, 1e-12, 1e-16])
def test_euler_angles_survive_gimbal_lock(nose: float, short_of_it: float) -> None:
    quaternion = quaternion_from_euler(0.4, nose * (math.pi / 2 - short_of_it), -1.1)
    again = quaternion_from_euler(*euler_from_quaternion(quaternion))
    assert angle_between(quaternion, again) < 1e-13


def test_heading_is_the_heading_of_the_nose() -> None:
    nose = RANDOM.apply([1.0, 0.0, 0.0])
    assert_allclose(heading_from_quaternion(QUATERNIONS), np.arctan2(nose[:, 1], nose[:, 0]))


def test_rotation_matrix_is_scipys() -> None:
    assert_allclose(rotation_from_quaternion(QUATERNIONS), RANDOM.as_matrix(), atol=1e-15)


def test_thrust_direction_is_the_third_body_axis() -> None:
    assert_allclose(
        thrust_direction_from_quaternion(QUATERNIONS), RANDOM.apply([0.0, 0.0, 1.0]), atol=1e-15
    )


@given(angles, st.floats(0, math.pi), angles, st.floats(0.01, 100))
def test_attitude_from_thrust_direction_has_both(
    azimuth: float, tilt: float, heading: float, length: float
) -> None:
    """Any direction, also upside down: the third axis is b, the nose points along the heading."""
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


def test_attitude_from_thrust_direction_is_the_textbooks_frame() -> None:
    """y_C = (-sin psi, cos psi, 0), x_b = y_C x z_b normalised, y_b = z_b x x_b."""
    generator = np.random.default_rng(6)
    direction = generator.normal(size=(200, 3)) * [1, 1, 0] + [0, 0, 1.2]
    heading = generator.uniform(-np.pi, np.pi, 200)
    z_b = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    x_b = np.cross(np.stack([-np.sin(heading), np.cos(heading), 0 * heading], axis=1), z_b)
    x_b /= np.linalg.norm(x_b, axis=1, keepdims=True)
    expected = np.stack([x_b, np.cross(z_b, x_b), z_b], axis=2)
    attitude = scipy_rotation(quaternion_from_thrust_direction(direction, heading))
    assert_allclose(attitude.as_matrix(), expected, atol=1e-14)


@pytest.mark.parametrize("heading", [0.0, 0.7, -2.5])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_thrust_sideways_keeps_the_heading(heading: float, side: float) -> None:
    """b along the heading's own y axis leaves the nose undetermined by the cross product."""
    direction = side * np.array([-math.sin(heading), math.cos(heading), 0.0])
    attitude = scipy_rotation(quaternion_from_thrust_direction(direction, heading))
    assert_allclose(attitude.apply([0, 0, 1]), direction, atol=1e-15)
    assert_allclose(
        attitude.apply([1, 0, 0]), [math.cos(heading), math.sin(heading), 0], atol=1e-15
    )


@pytest.mark.parametrize(
    "direction", [(0.0, 0.0, 0.0), (-0.0, 0.0, -0.0), (math.nan, 0.1, 1.0), (0.0, math.inf, 1.0)]
)
def test_no_usable_thrust_direction_is_level(direction: tuple[float, float, float]) -> None:
    assert_allclose(
        quaternion_from_thrust_direction(direction, 0.8), quaternion_from_euler(0, 0, 0.8)
    )


@given(any_float, any_float, any_float, any_float)
def test_an_attitude_is_finite_and_unit_whatever_is_asked(
    north: float, east: float, down: float, heading: float
) -> None:
    quaternion = quaternion_from_thrust_direction((north, east, down), heading)
    assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize("heading", [math.nan, math.inf, -math.inf])
def test_a_heading_that_is_none_is_north(heading: float) -> None:
    direction = [0.1, -0.2, 0.9]
    assert_array_equal(
        quaternion_from_thrust_direction(direction, heading),
        quaternion_from_thrust_direction(direction, 0.0),
    )


@given(st.floats(-1e6, 1e6))
def test_wrap_keeps_the_angle_and_the_range(angle: float) -> None:
    wrapped = wrap_pi(angle)
    assert -math.pi <= wrapped <= math.pi
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert wrap_pi(np.array([angle]))[0] == pytest.approx(wrapped, abs=1e-9) or abs(
        wrapped
    ) == pytest.approx(math.pi, abs=1e-9)


@given(angles)
def test_wrap_leaves_angles_already_inside_exactly_alone(angle: float) -> None:
    assert wrap_pi(angle) == angle
    assert wrap_pi(np.array([angle]))[0] == angle


def test_leading_axes_broadcast_and_single_values_agree() -> None:
    """What works for one works for (5, 100), to the last bit."""
    many = QUATERNIONS.reshape(5, 100, 4)
    other = QUATERNIONS[:100]
    angle = euler_from_quaternion(many)
    direction = thrust_direction_from_quaternion(many)
    heading = heading_from_quaternion(other)
    results = {
        "euler": (angle, lambda i, j: euler_from_quaternion(many[i, j])),
        "heading": (
            heading_from_quaternion(many),
            lambda i, j: np.asarray(heading_from_quaternion(many[i, j])),
        ),
        "matrix": (
            rotation_from_quaternion(many),
            lambda i, j: rotation_from_quaternion(many[i, j]),
        ),
        "direction": (direction, lambda i, j: thrust_direction_from_quaternion(many[i, j])),
        "attitude": (
            quaternion_from_thrust_direction(direction, heading),
            lambda i, j: quaternion_from_thrust_direction(direction[i, j], heading[j]),
        ),
        "from euler": (
            quaternion_from_euler(angle[..., 0], angle[..., 1], 0.5),
            lambda i, j: quaternion_from_euler(angle[i, j, 0], angle[i, j, 1], 0.5),
        ),
    }
    for name, (batch, single) in results.items():
        assert batch.shape[:2] == (5, 100), name
        for i, j in ((0, 0), (2, 57), (4, 99)):
            assert_allclose(batch[i, j], single(i, j), rtol=0, atol=1e-15, err_msg=name)


def test_level_and_north_is_the_identity() -> None:
    assert_array_equal(quaternion_from_euler(0, 0, 0), [1, 0, 0, 0])
    assert_array_equal(thrust_direction_from_quaternion([1, 0, 0, 0]), [0, 0, 1])
    assert_array_equal(euler_from_quaternion([1, 0, 0, 0]), [0, 0, 0])
