"""What every reference offers: the flat outputs (position and course) and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class FlatSample:
    """Flat outputs at one or several times. NED, SI; leading shape (...) follows the time argument.

    Positions to snap have shape (..., 3); course (heading of the nose, 0 = north, positive
    clockwise, unwrapped along a reference) and its derivatives have shape (...).
    """

    position_ned_m: Array
    velocity_ned_mps: Array
    acceleration_ned_mps2: Array
    jerk_ned_mps3: Array
    snap_ned_mps4: Array
    course_rad: Array
    course_rate_radps: Array
    course_acceleration_radps2: Array


class Reference(Protocol):
    """A trajectory from time 0 to `duration_s`; before and after it rests at its ends."""

    @property
    def duration_s(self) -> float: ...

    def sample(self, time_s: float | Array) -> FlatSample:
        """Evaluate at `time_s`, a scalar or an array of any shape."""
        ...
