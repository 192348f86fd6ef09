"""Flight plan: the reference in force at each vehicle time: the climb, then the track."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from offboard.reference.base import FlatSample, Reference
from offboard.reference.track import Track
from offboard.reference.transfer import Placed, Shifted, transfer

Array = NDArray[np.float64]
SETTLED_DISTANCE_M = 0.3
SETTLED_SPEED_MPS = 0.3


class FlightPlan:
    """The reference in force: none on the ground, then by `start_climb` and `start_track`.

    `origin_ned_m` is the take-off point; the track's positions are relative to it.
    """

    def __init__(self, track: Track) -> None:
        self.track = track
        self.origin_ned_m = (0.0, 0.0, 0.0)
        self._track_began_s = math.nan
        self._arrival_s = math.nan
        self.reference: Reference | None = None

    def start_climb(
        self, time_s: float, position: Array, velocity: Array, course_rad: float
    ) -> None:
        """Fly from this position and velocity (3,) to rest at the start of the track."""
        start = self._placed().sample(0.0)
        climb = transfer(
            position,
            start.position_ned_m,
            course_rad,
            float(start.course_rad),
            start_velocity_ned_mps=velocity,
        )
        self._arrival_s = time_s + climb.duration_s
        self.reference = Shifted(climb, time_s)

    def start_track(self, time_s: float) -> None:
        """Fly the track, whose time 0 is `time_s`."""
        self._track_began_s = time_s
        self.reference = Shifted(self._placed(), time_s)

    def track_time_s(self, time_s: float) -> float:
        """Time since the start of the track; NaN before it."""
        return time_s - self._track_began_s

    def late_s(self, time_s: float) -> float:
        """Time since the planned end of the climb; negative before it, NaN without a climb."""
        return time_s - self._arrival_s

    def at_start(self, time_s: float, position: Array, velocity: Array) -> bool:
        """Whether the planned climb is over and the vehicle hovers at its end."""
        if not time_s >= self._arrival_s or self.reference is None:
            return False
        target = self.reference.sample(time_s)
        return bool(
            np.linalg.norm(position - target.position_ned_m) < SETTLED_DISTANCE_M
            and np.linalg.norm(velocity) < SETTLED_SPEED_MPS
        )

    def sample(self, time_s: float) -> FlatSample | None:
        """The reference at a vehicle time; None on the ground."""
        return None if self.reference is None else self.reference.sample(time_s)

    def _placed(self) -> Reference:
        return Placed(self.track, self.origin_ned_m)
