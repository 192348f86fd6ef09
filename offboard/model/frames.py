"""Rotations between NED and the body (FRD): quaternions, Euler angles, the thrust direction.

A quaternion is [w, x, y, z], Hamilton, of unit length, and turns FRD components into NED components
(as in ATTITUDE_QUATERNION and SET_ATTITUDE_TARGET). Euler angles are Z-Y-X (yaw psi, pitch
theta, roll phi), rad. The thrust direction b is the third body axis in NED, (0, 0, 1) when level.

All functions are pure and broadcast over leading axes. A single rotation is computed with Python
floats, because the control loop needs hundreds of them per second.
"""

from __future__ import annotations

import math
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_TURN = 2.0 * math.pi


@overload
def wrap_pi(angle_rad: float) -> float: ...
@overload
def wrap_pi(angle_rad: Array) -> Array: ...
def wrap_pi(angle_rad: float | Array) -> float | Array:
    """Angle (...) rad -> the same angle in [-pi, pi]; exact where it is already in this range."""
    if isinstance(angle_rad, (float, int)):
        return math.remainder(angle_rad, _TURN) if math.isfinite(angle_rad) else math.nan
    angles: Array = np.asarray(angle_rad, dtype=np.float64)
    return angles - _TURN * np.rint(angles / _TURN)


def quaternion_from_euler(phi_rad: ArrayLike, theta_rad: ArrayLike, psi_rad: ArrayLike) -> Array:
    """Roll, pitch, yaw, each (...) rad -> quaternion (..., 4)."""
    sin_phi, cos_phi = _half_sine_cosine(phi_rad)
    sin_theta, cos_theta = _half_sine_cosine(theta_rad)
    sin_psi, cos_psi = _half_sine_cosine(psi_rad)
    return _stack(
        cos_phi * cos_theta * cos_psi + sin_phi * sin_theta * sin_psi,
        sin_phi * cos_theta * cos_psi - cos_phi * sin_theta * sin_psi,
        cos_phi * sin_theta * cos_psi + sin_phi * cos_theta * sin_psi,
        cos_phi * cos_theta * sin_psi - sin_phi * sin_theta * cos_psi,
    )


def euler_from_quaternion(quaternion: ArrayLike) -> Array:
    """Quaternion (..., 4) of any non-zero length -> [phi, theta, psi] (..., 3) rad.

    theta in [-pi/2, pi/2], phi and psi in [-pi, pi]. Half the sum and half the difference of roll
    and yaw are computed separately, so that the angles describe the rotation at theta = +-pi/2 too.
    """
    w, x, y, z = _components(quaternion)
    half_sum = np.arctan2(x + z, w - y)
    half_difference = np.arctan2(z - x, w + y)
    theta = 2.0 * np.arctan2(np.hypot(z - x, w + y), np.hypot(x + z, w - y)) - 0.5 * math.pi
    return _stack(wrap_pi(half_sum - half_difference), theta, wrap_pi(half_sum + half_difference))


def heading_from_quaternion(quaternion: ArrayLike) -> Any:
    """Quaternion (..., 4) -> heading of the nose (...), Euler psi in [-pi, pi] rad, 0 = north."""
    w, x, y, z = _components(quaternion)
    return wrap_pi(np.arctan2(x + z, w - y) + np.arctan2(z - x, w + y))


def rotation_from_quaternion(quaternion: ArrayLike) -> Array:
    """Unit quaternion (..., 4) -> rotation matrix (..., 3, 3), FRD -> NED; columns = body axes."""
    w, x, y, z = _components(quaternion)
    entries = _stack(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip
    return entries.reshape(*entries.shape[:-1], 3, 3)


def thrust_direction_from_quaternion(quaternion: ArrayLike) -> Array:
    """Unit quaternion (..., 4) -> third body axis b in NED (..., 3)."""
    w, x, y, z = _components(quaternion)
    return _stack(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y))


def quaternion_from_thrust_direction(direction_ned: ArrayLike, heading_rad: Any) -> Array:
    """Third body axis b (..., 3) of any length and heading psi (...) -> quaternion (..., 4).

    The body y axis is normal to the plane of b and the heading direction, so that Euler psi equals
    the heading, upside down too. If b is normal to the vertical plane of the heading, the roll is
    +-pi/2.
    """
    north, east, down = _components(direction_ned)
    ahead = north * np.cos(heading_rad) + east * np.sin(heading_rad)
    right = east * np.cos(heading_rad) - north * np.sin(heading_rad)
    sign = np.copysign(1.0, down)
    phi = np.arctan2(-right, sign * np.hypot(ahead, down))
    theta = np.arctan2(sign * ahead, sign * down)
    return quaternion_from_euler(phi, theta, heading_rad)


def enu(ned: ArrayLike) -> Array:
    """Vectors (..., 3) in NED -> in ENU (east, north, up; REP 103)."""
    north, east, down = _components(ned)
    return _stack(east, north, -down)


def flu_in_enu(quaternion: ArrayLike) -> Array:
    """Quaternion (..., 4) -> quaternion that turns FLU body components (forward, left, up; REP 103)
    into ENU components: it is multiplied by half a turn about the axis midway between north and
    east on the left, and by half a turn about the forward axis on the right."""
    w, x, y, z = _components(quaternion)
    half = math.sqrt(0.5)
    return _stack(-half * (w + z), -half * (x + y), half * (y - x), half * (z - w))


def _half_sine_cosine(angle_rad: Any) -> tuple[Any, Any]:
    if isinstance(angle_rad, (float, int)):
        return math.sin(0.5 * angle_rad), math.cos(0.5 * angle_rad)
    half = 0.5 * np.asarray(angle_rad, dtype=np.float64)
    return np.sin(half), np.cos(half)


def _components(vectors: ArrayLike) -> Any:
    """Return the elements of the last axis: Python floats of one vector, views (...) of many."""
    if isinstance(vectors, tuple) and isinstance(vectors[0], float):
        return vectors
    array = np.asarray(vectors, dtype=np.float64)
    return array.tolist() if array.ndim == 1 else np.moveaxis(array, -1, 0)


def _stack(*parts: Any) -> Array:
    if isinstance(parts[0], float):
        return np.array(parts, dtype=np.float64)
    return np.stack(np.broadcast_arrays(*parts), axis=-1)
