"""The state of the vehicle at the time when a command sent now takes effect. Values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PredictedHeave:
    """The vertical motion at `time_s`, vehicle time, when the *thrust* of a command sent now takes
    effect: down is positive; `thrust_down_mps2` is T b_z."""

    time_s: float
    position_down_m: float
    velocity_down_mps: float
    thrust_down_mps2: float


@dataclass(frozen=True, slots=True)
class PredictedState:
    """The observer's state at `time_s`, vehicle time, when a command sent now takes effect.

    Shapes (3,), NED, SI. `thrust_direction_ned` is the third body axis b and
    `thrust_direction_rate_ned_ps` its derivative; acceleration = g e3 - T b - c v + d with
    `disturbance_ned_mps2` d and `thrust_mps2` T (after the thrust's lag).

    Thrust acts sooner than tilt. A vertical loop closed on `time_s` would wait for the tilt and,
    from a difference of about 0.1 s on, cycle; `heave` is the vertical motion at its own time.
    """

    time_s: float
    position_ned_m: Array
    velocity_ned_mps: Array
    thrust_direction_ned: Array
    thrust_direction_rate_ned_ps: Array
    course_rad: float
    course_rate_radps: float
    thrust_mps2: float
    disturbance_ned_mps2: Array
    rates_frd_radps: Array
    heave: PredictedHeave | None = None
