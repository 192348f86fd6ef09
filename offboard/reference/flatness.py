"""Differential flatness: computes the full state and the input from position and heading.

The plant is a = g e3 - T b - c v + d (NED; thrust T per unit of mass, third body axis b, linear
drag c, constant disturbance d), so that T b = g e3 - a - c v + d =: f. Attitude, body rates and
thrust follow from f and its derivatives in closed form (Mellinger and Kumar, 2011, with drag).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.model.axes import acceleration
from offboard.reference.base import FlatSample

Array = NDArray[np.float64]

_THRUST_FLOOR_MPS2 = 1e-3
_LEVEL_FLOOR = 1e-3  # least divisor of the body rates, for b_z and |y_C x b|
_NO_DISTURBANCE = np.zeros(3)
_LEVEL = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class FlatState:
    """State and input that follow a `FlatSample`; the leading shape (...) is that of the sample.

    thrust_mps2, thrust_rate_mps3 (...): T and T'. thrust_direction_ned, _rate_ned_ps,
    _acceleration_ned_ps2 (..., 3): b, b', b''; without thrust b is (0, 0, 1).
    """

    thrust_mps2: Array
    thrust_rate_mps3: Array
    thrust_direction_ned: Array
    thrust_direction_rate_ned_ps: Array
    thrust_direction_acceleration_ned_ps2: Array


def flat_state(
    sample: FlatSample,
    gravity_mps2: float,
    drag_per_mass_ps: float,
    disturbance_ned_mps2: Array = _NO_DISTURBANCE,
) -> FlatState:
    """Return the full state and input of a sample; the disturbance (3,) is constant in time.

    The result is always finite: where f is zero (free fall) b is (0, 0, 1)."""
    drag, gravity = drag_per_mass_ps, np.array([0.0, 0.0, gravity_mps2])
    f = acceleration(
        gravity, sample.acceleration_ned_mps2, drag, sample.velocity_ned_mps, disturbance_ned_mps2
    )
    f1 = -sample.jerk_ned_mps3 - drag * sample.acceleration_ned_mps2
    f2 = -sample.snap_ned_mps4 - drag * sample.jerk_ned_mps3
    thrust = np.sqrt(_dot(f, f))
    safe = np.maximum(thrust, _THRUST_FLOOR_MPS2)
    b = np.where(thrust < _THRUST_FLOOR_MPS2, _LEVEL, f / safe)
    # f = T b, differentiated once and twice; b is orthogonal to b'
    thrust1 = _dot(b, f1)
    b1 = (f1 - thrust1 * b) / safe
    thrust2 = _dot(b1, f1) + _dot(b, f2)
    b2 = (f2 - thrust2 * b - 2.0 * thrust1 * b1) / safe
    return FlatState(
        thrust_mps2=thrust[..., 0],
        thrust_rate_mps3=thrust1[..., 0],
        thrust_direction_ned=b,
        thrust_direction_rate_ned_ps=b1,
        thrust_direction_acceleration_ned_ps2=b2,
    )


def _dot(left: Array, right: Array) -> Array:
    """Return the dot product over the last axis, (..., 1)."""
    product: Array = (left * right).sum(axis=-1, keepdims=True)
    return product


def body_rates(sample: FlatSample, state: FlatState) -> Array:
    """Return the body rates p, q, r (..., 3), rad/s, of a body whose third axis is b and whose
    Euler yaw is the heading: p and q follow from b' = R (omega x e3), r from the kinematics of the
    yaw, psi' = (q sin phi + r cos phi) / cos theta."""
    b, b1 = state.thrust_direction_ned, state.thrust_direction_rate_ned_ps
    cosine, sine, down = np.cos(sample.heading_rad), np.sin(sample.heading_rad), b[..., 2]
    x = np.stack([cosine * down, sine * down, -cosine * b[..., 0] - sine * b[..., 1]], axis=-1)
    # y_C x b, y_C = (-sin, cos, 0); the sign keeps the nose along the heading upside down too
    x /= np.copysign(np.maximum(np.sqrt(_dot(x, x)), _LEVEL_FLOOR), b[..., 2:])
    y = np.cross(b, x)
    p, q = -_dot(y, b1)[..., 0], _dot(x, b1)[..., 0]
    level = np.where(np.abs(down) > _LEVEL_FLOOR, down, _LEVEL_FLOOR)
    r = (sample.heading_rate_radps * (1.0 - x[..., 2] ** 2) - q * y[..., 2]) / level
    return np.stack([p, q, r], axis=-1)
