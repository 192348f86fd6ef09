"""Interface of every reference: position and heading with their derivatives (flat outputs)."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from offboard.model.command import PositionCommand

Array = NDArray[np.float64]


class FlatSample(NamedTuple):
    """A reference at one or several times. NED, SI. The leading shape (...) is that of the time.

    Attributes:
        position_ned_m ... snap_ned_mps4: (..., 3), position and its first four derivatives by time.
        heading_rad: (...), heading of the nose: 0 = north, clockwise. Continuous along a reference,
            so it may leave -pi .. pi.
        heading_rate_radps, heading_acceleration_radps2: (...), its derivatives.
    """

    position_ned_m: Array
    velocity_ned_mps: Array
    acceleration_ned_mps2: Array
    jerk_ned_mps3: Array
    snap_ned_mps4: Array
    heading_rad: Array
    heading_rate_radps: Array
    heading_acceleration_radps2: Array

    def setpoint(self) -> PositionCommand:
        """Return the setpoint of the autopilot's position loop; for a sample of a single time."""
        position, velocity, acceleration = (
            (float(vector[0]), float(vector[1]), float(vector[2])) for vector in self[:3]
        )
        heading_rad, rate_radps = float(self.heading_rad), float(self.heading_rate_radps)
        return PositionCommand(position, velocity, acceleration, heading_rad, rate_radps)


class Reference(Protocol):
    """A trajectory from time 0 to `duration_s`; before and after that it is at rest at its ends.

    Example:
        sample = reference.sample(np.array([0.0, 0.1]))
        sample.position_ned_m  # (2, 3)
    """

    @property
    def duration_s(self) -> float:
        """The time at which the trajectory comes to rest, s."""
        ...

    def sample(self, time_s: float | Array) -> FlatSample:
        """Return the sample at `time_s`, a scalar or an array of any shape."""
        ...
