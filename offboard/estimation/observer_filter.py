"""What the observer computes, compiled: one record, and what a message does to it.

The record holds the believed state, the commands sent, three filters (both lateral axes, vertical,
course) and what is learnt of their noise. Which message counts, and what a silence or the ground
mean, is for the observer to say. Knows no settings and no quaternion.
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
# Places in them: per lateral axis [p v b b' d beta], vertical [p v d beta], course [psi psi'].
LATERAL_TILT, LATERAL_DRIFT, VERTICAL_DRIFT, HEADING_COURSE = 2, 4, 2, 0
POSITION_JUMPED, VELOCITY_JUMPED = 1, 2  # bits of an answer

OBSERVER = np.dtype(
    [
        ("time_s", "f8"),  # vehicle time of the state
        ("motion", MOTION),
        ("filters", FILTER, 3),
        ("adaptation", ADAPTATION),
        # settings
        ("uses_velocity", "i8"),  # with a bias of its own
        ("adaptive", "i8"),
        ("white_sds", "f8", 2),  # of position and velocity, where they are not adaptive
        ("gates", "f8", 2),  # beyond which they have jumped
        ("attitude_sd", "f8"),
        ("disturbance_limit", "f8"),
        # scratch
        ("measured", "f8", VELOCITY + 3),  # placed as in the state
    ],
    align=True,
)
"""One vehicle's observer."""


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
    """Correct the state by the position and velocity in `measured`. Returns what jumped:
    POSITION_JUMPED, VELOCITY_JUMPED, both or 0."""
    observer = observers[0]
    state, measured, learnt = observer.motion.states[NOW], observer.measured, observer.adaptation
    _note_missed(state, measured, learnt.innovation)
    jumped = 0
    for kind in range(2):
        if kind == 1 and not observer.uses_velocity:
            continue
        sd = white_sd(learnt, kind) if observer.adaptive else observer.white_sds[kind]
        for i in range(2):
            one = observer.filters[i]
            other = NOTHING if kind == 0 else one.order - 1
            if not correct_within(state, one, kind, other, measured, sd, observer.gates[kind]):
                jumped |= 1 << kind
                if kind == 0:
                    anchor_position(state, one, measured, sd)
                else:
                    anchor_bias(state, one, sd)
    bound_disturbance(state, observer.disturbance_limit)
    return jumped


@entry(OBSERVER)
def learn(observers: Any) -> None:
    """Learn noise and drift from the position that the state was last corrected by."""
    observer = observers[0]
    learnt = observer.adaptation
    _note_missed(observer.motion.states[NOW], observer.measured, learnt.residual)
    note(learnt, observer.time_s)
    observer.filters[LATERAL].densities[LATERAL_DRIFT] = learnt.density[NORTH_EAST]
    observer.filters[VERTICAL].densities[VERTICAL_DRIFT] = learnt.density[DOWN]


@kernel
def _note_missed(state: Array, measured: Array, missed: Array) -> None:
    """Measured less believed position and reported velocity."""
    for i in range(3):
        missed[i] = measured[POSITION + i] - state[POSITION + i]
        believed = state[VELOCITY + i]
        missed[3 + i] = measured[VELOCITY + i] - believed - state[BIAS + i]


def bring_forward(measured: Array, state: Array, plant: Array, late_s: float) -> None:
    """Move a position and velocity `measured` (6,) `late_s` before the state to its time."""
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
    """Hold each axis of the disturbance, m/s^2 NED, within `limit`, in place."""
    for i in range(DISTURBANCE, DISTURBANCE + 3):
        state[i] = min(max(state[i], -limit), limit)
