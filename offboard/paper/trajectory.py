"""The reference of Figs. 5 and 6. The paper draws its path without numbers; this one is similar.

About 100 s at some 3 m/s through turns and changes of height, minimum snap from rest to rest, the
nose along the path.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from functools import cache

import numpy as np
from numpy.typing import NDArray

from offboard.model.state import PHI, PSI, THETA, THRUST, P, R, U, V, W, X, Z
from offboard.model.vehicle import Vehicle
from offboard.paper.law import PAPER_STEP_S
from offboard.reference.base import FlatSample, Reference
from offboard.reference.flatness import flat_state
from offboard.reference.shapes import CourseMode, Hover, Waypoints
from offboard.reference.waypoints import Smoothness

Array = NDArray[np.float64]

POINTS_M = (
    (0.0, 0.0, 2.0), (20.0, 5.0, 2.0), (30.0, 25.0, 4.0), (10.0, 40.0, 6.0), (-15.0, 30.0, 6.0),
    (-25.0, 0.0, 4.0), (-10.0, -30.0, 4.0), (20.0, -40.0, 3.0), (45.0, -20.0, 2.0),
    (50.0, 10.0, 2.0),
)  # fmt: skip
SPEED_MPS = 2.8  # mean of an inner leg


class PathName(StrEnum):
    """The references of the study."""

    TOUR = "tour"  # Figs. 5 and 6
    HOVER = "hover"


@cache
def reference(name: PathName) -> Reference:
    """Position NED, velocity and course over vehicle time from 0."""
    if name is PathName.HOVER:
        return Hover(height_m=2.0, duration_s=60.0).track()
    return Waypoints(
        points_m=POINTS_M,
        speed_mps=SPEED_MPS,
        minimise=Smoothness.SNAP,
        course=CourseMode.ALONG_VELOCITY,
    ).track()


@dataclass(frozen=True, slots=True)
class SampledPath:
    """A reference at the steps k = 0 ... K of 0.1 s.

    `times_s` (K + 1,); `tracked` (K + 1, 12) is Eq. 27: zero except psi, u, v, w, x, y, z, with
    velocities in NED as on the linear plant; `samples` are the flat outputs.
    """

    times_s: Array
    tracked: Array
    samples: FlatSample


@cache
def sampled_path(name: PathName, steps: int) -> SampledPath:
    """The reference `name` at `steps` + 1 times."""
    times_s: Array = PAPER_STEP_S * np.arange(steps + 1, dtype=np.float64)
    samples = reference(name).sample(times_s)
    tracked = np.zeros((steps + 1, 12))
    tracked[:, PSI] = samples.course_rad
    tracked[:, U : W + 1] = samples.velocity_ned_mps
    tracked[:, X : Z + 1] = samples.position_ned_m
    return SampledPath(times_s, tracked, samples)


def linear_states(samples: FlatSample, vehicle: Vehicle) -> Array:
    """All states (..., 12) of the linear model when it follows the reference exactly."""
    gravity, drag = vehicle.gravity_mps2, vehicle.drag_per_mass_ps
    v, a, j = samples.velocity_ned_mps, samples.acceleration_ned_mps2, samples.jerk_ned_mps3
    states = np.zeros((*samples.course_rad.shape, 12))
    lean = (a + drag * v) / gravity  # u' = -g theta - c u, v' = g phi - c v
    lean_rate = (j + drag * a) / gravity
    states[..., PHI], states[..., THETA] = lean[..., 1], -lean[..., 0]
    states[..., P], states[..., P + 1] = lean_rate[..., 1], -lean_rate[..., 0]
    states[..., PSI], states[..., R] = samples.course_rad, samples.course_rate_radps
    states[..., U : W + 1] = v
    states[..., X : Z + 1] = samples.position_ned_m
    return states


def heading_states(samples: FlatSample, vehicle: Vehicle) -> Array:
    """The same (..., 12) for the nonlinear plant (flatness), in the heading frame of each sample;
    course and position are relative to the sample, hence 0."""
    flat = flat_state(samples, vehicle.gravity_mps2, vehicle.drag_per_mass_ps)
    cosine, sine = np.cos(samples.course_rad), np.sin(samples.course_rad)
    b, v = flat.thrust_direction_ned, samples.velocity_ned_mps
    along = cosine * b[..., 0] + sine * b[..., 1]
    across = cosine * b[..., 1] - sine * b[..., 0]
    states = np.zeros((*samples.course_rad.shape, 12))
    states[..., PHI], states[..., THETA] = np.arcsin(-across), np.arctan2(along, b[..., 2])
    states[..., P : R + 1] = flat.rates_frd_radps
    states[..., U] = cosine * v[..., 0] + sine * v[..., 1]
    states[..., V] = cosine * v[..., 1] - sine * v[..., 0]
    states[..., W] = v[..., 2]
    return states


def nominal_inputs(states: Array, samples: FlatSample, vehicle: Vehicle, tilted: bool) -> Array:
    """Inputs (K, 4) held between states (K + 1, 12); torques follow from the rates at both ends.

    `tilted`: increase the thrust by the part that tilt turns sideways, which the linear model
    neglects.
    """
    inertia, drag = np.array(vehicle.inertia_kgm2), np.array(vehicle.drag_rotation_nmpradps)
    rates = states[:, P : R + 1]
    inputs = np.empty((len(states) - 1, 4))
    inputs[:, 1:] = inertia * np.diff(rates, axis=0) / PAPER_STEP_S
    inputs[:, 1:] += 0.5 * drag * (rates[1:] + rates[:-1])
    inputs[:, 1:3] /= vehicle.arm_m
    upward = -(samples.acceleration_ned_mps2 + vehicle.drag_per_mass_ps * samples.velocity_ned_mps)
    upright = np.cos(states[:, PHI]) * np.cos(states[:, THETA]) if tilted else 1.0
    lift = vehicle.mass_kg * (vehicle.gravity_mps2 + upward[:, 2]) / upright
    inputs[:, THRUST] = 0.5 * (lift[1:] + lift[:-1]) - vehicle.mass_kg * vehicle.gravity_mps2
    return inputs
