"""Jumps of the reported position, which are resets of the vehicle's estimator, and its drift: a
position that moves otherwise than the reported velocity.

No message is needed for jumps (ODOMETRY.reset_counter: PX4 only): two positions some milliseconds
apart that no motion joins show one, on any autopilot.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from offboard.estimation.observer import GATES
from offboard.mavlink.events import LocalPosition

Array = NDArray[np.float64]

LEAST_JUMP_M = GATES[0]  # a smaller one is corrected as an error
ACCELERATION_MPS2 = 20.0  # that the reported velocities need not show
LONGEST_GAP_S = 0.5  # after a longer one nothing is concluded
RECENT_S = 10.0
NOISES = 6.0  # times the mean difference of successive positions; less is no jump, but noise
NOISE_SHARE = 0.01  # of the newest difference in this mean
DRIFT_S = 1.0  # time constant; real PX4 drifts by 0.7 m at most, without a fix by 14 m


class PositionJumps:
    """Finds the jumps between successive positions. `total_ned_m` (3,) is the sum of all.
    `drift_m`: by how much positions, without the jumps, and velocities of the last second
    contradict each other."""

    def __init__(self) -> None:
        self._newest: LocalPosition | None = None
        self._jumps: deque[tuple[float, float]] = deque()  # when, by how many metres
        self._noise_m = 0.0  # mean distance between a position and what the one before leads to
        self.total_ned_m: Array = np.zeros(3)
        self._drift_ned_m = (0.0, 0.0, 0.0)

    @property
    def drift_m(self) -> float:
        return math.hypot(*self._drift_ned_m)

    def on_position(self, position: LocalPosition) -> Array | None:
        """The jump (3,) from the position before to this one, NED in m; None without one."""
        before, self._newest = self._newest, position
        if before is None:
            return None
        passed_s = position.time_s - before.time_s
        if not 0.0 < passed_s < LONGEST_GAP_S:
            return None
        jump_m = [  # in floats: it is computed for every position
            here - there - passed_s * (0.5 * (speed + speed_there))
            for here, there, speed, speed_there in zip(
                position.position_ned_m, before.position_ned_m,
                position.velocity_ned_mps, before.velocity_ned_mps, strict=True,
            )
        ]  # fmt: skip
        size_m = math.hypot(*jump_m)
        least_m = max(LEAST_JUMP_M, NOISES * self._noise_m)
        least_m += 0.5 * ACCELERATION_MPS2 * passed_s**2
        self._noise_m += NOISE_SHARE * (min(size_m, least_m) - self._noise_m)
        if size_m <= least_m:
            kept = 1.0 - passed_s / DRIFT_S
            north, east, down = (
                kept * drift + new for drift, new in zip(self._drift_ned_m, jump_m, strict=True)
            )
            self._drift_ned_m = north, east, down
            return None
        self._jumps.append((position.time_s, size_m))
        jump = np.array(jump_m)
        self.total_ned_m = self.total_ned_m + jump
        return jump

    def recent_m(self, time_s: float) -> float:
        """Sum of the sizes of the jumps in the last RECENT_S."""
        while self._jumps and self._jumps[0][0] < time_s - RECENT_S:
            self._jumps.popleft()
        return sum(size_m for _, size_m in self._jumps)

    def forget(self) -> None:
        """What has been until now, on the ground, is no matter of the flight."""
        self._jumps.clear()
