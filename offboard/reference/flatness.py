"""Differential flatness: from position and course to the full state and the input.

The plant is acceleration = g e3 - T b - c v + d (NED; thrust T per unit of mass along b, the third
body axis; linear drag c; constant disturbance d), so that T b = g e3 - a - c v + d =: f. Attitude,
body rates and thrust follow from f and its derivatives in closed form. Pure arrays, compiled: a
controller calls this several times per decision.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from offboard.model.frames import quaternion_from_thrust_direction
from offboard.reference.base import FlatSample

Array = NDArray[np.float64]

_THRUST_FLOOR_MPS2 = 1e-3
_LEVEL_FLOOR = 1e-3  # least b_z and least |y_C x b| that the body rates are divided by
_NO_DISTURBANCE = np.zeros(3)


@dataclass(frozen=True, slots=True)
class FlatState:
    """State and input that fly a `FlatSample`; leading shape (...) is the sample's.

    thrust_mps2, thrust_rate_mps3 (...): T and T'. thrust_direction_ned, _rate_ned_ps,
    _acceleration_ned_ps2 (..., 3): b, b', b'', all zero-thrust safe (b is then (0, 0, 1)).
    rates_frd_radps (..., 3): p, q, r, with the Euler yaw equal to the course. course_rad (...).
    """

    thrust_mps2: Array
    thrust_rate_mps3: Array
    thrust_direction_ned: Array
    thrust_direction_rate_ned_ps: Array
    thrust_direction_acceleration_ned_ps2: Array
    rates_frd_radps: Array
    course_rad: Array

    @property
    def attitude(self) -> Array:
        """Quaternion w, x, y, z, FRD to NED, shape (..., 4). Computed at each call."""
        return quaternion_from_thrust_direction(self.thrust_direction_ned, self.course_rad)


def flat_state(
    sample: FlatSample,
    gravity_mps2: float,
    drag_per_mass_ps: float,
    disturbance_ned_mps2: Array = _NO_DISTURBANCE,
) -> FlatState:
    """The full state and input of a sample; the disturbance (3,) is constant in time.

    Always finite: where f vanishes (free fall) the thrust direction points down."""
    shape = sample.course_rad.shape
    thrusts, vectors = flatten(
        _rows(sample.velocity_ned_mps),
        _rows(sample.acceleration_ned_mps2),
        _rows(sample.jerk_ned_mps3),
        _rows(sample.snap_ned_mps4),
        np.ascontiguousarray(sample.course_rad, dtype=np.float64).reshape(-1),
        np.ascontiguousarray(sample.course_rate_radps, dtype=np.float64).reshape(-1),
        gravity_mps2,
        drag_per_mass_ps,
        np.ascontiguousarray(disturbance_ned_mps2, dtype=np.float64),
    )
    vectors = vectors.reshape(4, *shape, 3)
    thrusts = thrusts.reshape(2, *shape)
    return FlatState(
        thrust_mps2=thrusts[0, ...],
        thrust_rate_mps3=thrusts[1, ...],
        thrust_direction_ned=vectors[0],
        thrust_direction_rate_ned_ps=vectors[1],
        thrust_direction_acceleration_ned_ps2=vectors[2],
        rates_frd_radps=vectors[3],
        course_rad=sample.course_rad,
    )


def _rows(vectors: Array) -> Array:
    return np.ascontiguousarray(vectors, dtype=np.float64).reshape(-1, 3)


@numba.njit(cache=True)
def flatten(
    velocity: Array,
    acceleration: Array,
    jerk: Array,
    snap: Array,
    course: Array,
    course_rate: Array,
    gravity_mps2: float,
    drag_per_mass_ps: float,
    disturbance: Array,
) -> tuple[Array, Array]:
    """`flat_state` on rows: vectors (N, 3), course (N,); gives [T, T'] (2, N) and
    [b, b', b'', rates] (4, N, 3)."""
    count = course.size
    thrusts = np.empty((2, count))
    vectors = np.empty((4, count, 3))
    for i in range(count):
        f = disturbance - acceleration[i] - drag_per_mass_ps * velocity[i]
        f[2] += gravity_mps2
        f1 = -jerk[i] - drag_per_mass_ps * acceleration[i]
        f2 = -snap[i] - drag_per_mass_ps * jerk[i]
        thrust = np.sqrt(np.sum(f * f))
        if thrust < _THRUST_FLOOR_MPS2:
            b = np.array([0.0, 0.0, 1.0])
            safe = _THRUST_FLOOR_MPS2
        else:
            b = f / thrust
            safe = thrust
        # f = T b, differentiated once and twice; b is orthogonal to b'
        thrust1 = np.sum(b * f1)
        b1 = (f1 - thrust1 * b) / safe
        thrust2 = np.sum(b1 * f1) + np.sum(b * f2)
        b2 = (f2 - thrust2 * b - 2.0 * thrust1 * b1) / safe
        thrusts[0, i], thrusts[1, i] = thrust, thrust1
        vectors[0, i], vectors[1, i], vectors[2, i] = b, b1, b2
        body_rates(b, b1, course[i], course_rate[i], vectors[3, i])
    return thrusts, vectors


@numba.njit(cache=True)
def body_rates(b: Array, b1: Array, course: float, course_rate: float, out: Array) -> None:
    """p, q, r (3,) of a body whose third axis is b, moving as b1, and whose Euler yaw is the
    course: b' = R (omega x e3) gives p and q, the yaw's kinematics psi' = (q sin phi + r cos phi)
    / cos theta give r."""
    x = np.array([np.cos(course) * b[2], np.sin(course) * b[2], 0.0])
    x[2] = -np.cos(course) * b[0] - np.sin(course) * b[1]  # y_C x b, y_C = (-sin, cos, 0)
    x /= np.copysign(
        max(np.sqrt(np.sum(x * x)), _LEVEL_FLOOR), b[2]
    )  # the nose leads, upside down too
    y = np.cross(b, x)
    p, q = -np.sum(y * b1), np.sum(x * b1)
    level = b[2] if abs(b[2]) > _LEVEL_FLOOR else _LEVEL_FLOOR
    out[0], out[1] = p, q
    out[2] = (course_rate * (1.0 - x[2] * x[2]) - q * y[2]) / level
