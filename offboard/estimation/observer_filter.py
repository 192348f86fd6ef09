"""The observer's record and its corrections by attitude and position, compiled.

The record holds the estimated state, the commands sent, three filters (both lateral axes, vertical,
course) and what their noise is estimated from. Which messages are used is decided in `observer`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import entry, kernel
from offboard.estimation.filtering import (
    FILTER,
    NOTHING,
    anchor_bias,
    anchor_position,
    correct,
    correct_within,
)
from offboard.estimation.observer_adaptation import (
    ADAPTATION,
    DOWN,
    NORTH_EAST,
    note,
    white_sd,
)
from offboard.estimation.propagation import (
    BIAS,
    COURSE,
    COURSE_RATE,
    DISTURBANCE,
    DRAG,
    GRAVITY,
    MOTION,
    NOW,
    POSITION,
    THRUST,
    TILT,
    TILT_RATE,
    VELOCITY,
    wrapped,
)
from offboard.model.axes import upright

Array = NDArray[np.float64]

LATERAL, VERTICAL, HEADING = 0, 1, 2  # filters
# Their states: lateral [p v b b' d beta] per axis, vertical [p v d beta], course [psi psi'].
LATERAL_TILT, LATERAL_DRIFT, VERTICAL_DRIFT, HEADING_COURSE = 2, 4, 2, 0

OBSERVER = np.dtype(
    [
        ("time_s", "f8"),  # vehicle time of the state
        ("motion", MOTION),
        ("filters", FILTER, 3),
        ("adaptation", ADAPTATION),
        # settings
        ("uses_velocity", "i8"),  # whether the reported velocity is used, with a bias
        ("adaptive", "i8"),
        ("white_sds", "f8", 2),  # noise of position and velocity, if not adaptive
        ("gates", "f8", 2),  # jumps of position and velocity are larger
        ("attitude_sd", "f8"),
        ("disturbance_limit", "f8"),
        # scratch
        ("measured", "f8", VELOCITY + 3),  # indices as in the state
    ],
    align=True,
)
"""Record of one vehicle's observer."""


@entry(OBSERVER, float, float, float, float)
def correct_by_attitude(
    observers: Any, time_s: float, north: float, east: float, course: float
) -> None:
    """Correct the state by an attitude measured at `time_s`, not later than the state: thrust
    direction (north and east components) and course (rad). `observers` is one OBSERVER (1,)."""
    observer = observers[0]
    state, late_s = observer.motion.states[NOW], observer.time_s - time_s
    lateral, heading = observer.filters[LATERAL], observer.filters[HEADING]
    lateral.innovation[0] = north - state[TILT] + late_s * state[TILT_RATE]
    lateral.innovation[1] = east - state[TILT + 1] + late_s * state[TILT_RATE + 1]
    heading.innovation[0] = wrapped(course - state[COURSE] + late_s * state[COURSE_RATE])
    correct(state, lateral, LATERAL_TILT, NOTHING, observer.attitude_sd)
    correct(state, heading, HEADING_COURSE, NOTHING, observer.attitude_sd)
    bound_disturbance(state, observer.disturbance_limit)


@entry(OBSERVER)
def correct_by_position(observers: Any) -> int:
    """Correct the state by the position and velocity in `measured`. Returns 1 if one of
    them jumped, else 0."""
    observer = observers[0]
    state, measured, adaptation = (
        observer.motion.states[NOW],
        observer.measured,
        observer.adaptation,
    )
    _note_missed(state, measured, adaptation.innovation)
    jumped = 0
    for kind in range(2):
        if kind == 1 and not observer.uses_velocity:
            continue
        sd = white_sd(adaptation, kind) if observer.adaptive else observer.white_sds[kind]
        for i in range(2):
            one = observer.filters[i]
            other = NOTHING if kind == 0 else one.order - 1
            if not correct_within(state, one, kind, other, measured, sd, observer.gates[kind]):
                jumped = 1
                if kind == 0:
                    anchor_position(state, one, measured, sd)
                else:
                    anchor_bias(state, one, sd)
    bound_disturbance(state, observer.disturbance_limit)
    return jumped


@entry(OBSERVER)
def learn(observers: Any) -> None:
    """Estimate noise and drift from the last correction by position."""
    observer = observers[0]
    adaptation = observer.adaptation
    _note_missed(observer.motion.states[NOW], observer.measured, adaptation.residual)
    note(adaptation, observer.time_s)
    observer.filters[LATERAL].densities[LATERAL_DRIFT] = adaptation.density[NORTH_EAST]
    observer.filters[VERTICAL].densities[VERTICAL_DRIFT] = adaptation.density[DOWN]


@kernel
def _note_missed(state: Array, measured: Array, missed: Array) -> None:
    """Fill `missed` (6,) with measured less estimated position and reported velocity."""
    for i in range(3):
        missed[i] = measured[POSITION + i] - state[POSITION + i]
        estimated = state[VELOCITY + i]
        missed[3 + i] = measured[VELOCITY + i] - estimated - state[BIAS + i]


def bring_forward(measured: Array, state: Array, plant: Array, late_s: float) -> None:
    """Propagate position and velocity `measured` (6,) by `late_s`, to the time of the state."""
    north, east = state[TILT], state[TILT + 1]
    direction = (north, east, upright(north, east))
    for i in range(3):
        speed = state[VELOCITY + i]
        acceleration = direction[i] * -state[THRUST] + state[DISTURBANCE + i] - plant[DRAG] * speed
        if i == 2:
            acceleration += plant[GRAVITY]
        measured[POSITION + i] += late_s * speed
        measured[VELOCITY + i] += late_s * acceleration


@kernel
def bound_disturbance(state: Array, limit: float) -> None:
    """Limit each axis of the disturbance (m/s^2, NED) to `limit`, in place."""
    for i in range(DISTURBANCE, DISTURBANCE + 3):
        state[i] = min(max(state[i], -limit), limit)
