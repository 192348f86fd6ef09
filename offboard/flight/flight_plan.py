"""The references of one flight in vehicle time: climb to the start, the track, the rest."""

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
    """Which reference is in force. Starts on the ground; `lift_off` and `join` move it on."""

    def __init__(self, track: Track) -> None:
        self._track = track
        self.origin_ned_m = (0.0, 0.0, 0.0)
        self._join_s = math.nan
        self._arrival_s = math.nan
        self.reference: Reference | None = None

    @property
    def track(self) -> Track:
        return self._track

    def settle(self, position_ned_m: tuple[float, float, float]) -> None:
        """Remember the take-off point: references are given relative to it."""
        self.origin_ned_m = position_ned_m

    def lift_off(self, time_s: float, position: Array, velocity: Array, course_rad: float) -> None:
        """Plan from the present state to rest at the start of the track."""
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

    def join(self, time_s: float) -> None:
        """Start the track's own clock."""
        self._join_s = time_s
        self.reference = Shifted(self._placed(), time_s)

    def track_time_s(self, time_s: float) -> float:
        """Time on the track's own axis; NaN before it is joined."""
        return time_s - self._join_s

    def late_s(self, time_s: float) -> float:
        """How long ago the start should have been reached; negative before, NaN without a plan."""
        return time_s - self._arrival_s

    def at_start(self, time_s: float, position: Array, velocity: Array) -> bool:
        """The climb's plan is over and the vehicle rests at its end."""
        if not time_s >= self._arrival_s or self.reference is None:
            return False
        target = self.reference.sample(time_s)
        return bool(
            np.linalg.norm(position - target.position_ned_m) < SETTLED_DISTANCE_M
            and np.linalg.norm(velocity) < SETTLED_SPEED_MPS
        )

    def sample(self, time_s: float) -> FlatSample | None:
        """The reference in force at a vehicle time; None on the ground."""
        return None if self.reference is None else self.reference.sample(time_s)

    def _placed(self) -> Reference:
        return Placed(self._track, self.origin_ned_m)
