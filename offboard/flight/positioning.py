"""What is wrong with the reported position: what the estimate has lost since the beginning of the
flight, and its jumps and drift.

PX4 goes on under attitude setpoints when its GPS is lost, and reports a position that drifts away:
0.5 m in the first second, 10 m in fifteen. Only what was there at the beginning can be lost: a
vehicle may fly by motion capture or optical flow, without GPS.

Jumps are resets of the vehicle's estimator. No message is needed for them
(ODOMETRY.reset_counter: PX4 only): on any autopilot, two positions some milliseconds apart that
are too far from each other for any motion show one.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.estimation.observer import GATES
from offboard.flight.phases import Limits
from offboard.flight.vehicle_state import VehicleState
from offboard.mavlink.events import EstimatorReport, GpsFix, LocalPosition, NoFix

KNOWN_S = 2.5  # age of a report that counts when the flight begins
SILENT_S, SILENT_MESSAGES = 2.0, 10.0  # missing in a row: no loss of the link
WORSE = 2.0  # times the accuracy of the beginning, where that was no better than the limit


@dataclass(slots=True)
class Positioning:
    """What the position estimate had when the flight began; nothing before that."""

    had_fix: bool = False
    had_valid: frozenset[str] = frozenset()  # parts of the estimate
    accuracy_m: float | None = None
    fixes_hz: float = 0.0
    reports_hz: float = 0.0

    def begin(self, vehicle: VehicleState, rates_hz: Mapping[str, float], estimator: str) -> None:
        """The flight begins. `rates_hz` of the messages that arrive, `estimator` the name of the
        one that becomes an EstimatorReport."""
        self.had_fix = vehicle.age_s(GpsFix) < KNOWN_S
        self.fixes_hz = rates_hz.get("GPS_RAW_INT", 0.0)
        report = vehicle.estimator
        if report is not None and vehicle.age_s(EstimatorReport) < KNOWN_S:
            self.had_valid, self.accuracy_m = report.valid, report.accuracy_m
            self.reports_hz = rates_hz.get(estimator, 0.0)

    def lost(self, vehicle: VehicleState, limits: Limits) -> str:
        """What is lost, as a sentence; empty if nothing is."""
        fix_age_s, report = vehicle.age_s(GpsFix), vehicle.estimator
        if self.had_fix and fix_age_s > limits.gps_s and vehicle.age_s(NoFix) < fix_age_s:
            return f"GPS has no fix for {fix_age_s:.1f} s"
        if self.had_fix and fix_age_s > max(_silent_s(self.fixes_hz), limits.gps_s):
            return f"no GPS_RAW_INT for {fix_age_s:.1f} s"
        if report is None:
            return ""
        missing = sorted(self.had_valid - report.valid)
        if missing:
            return f"its estimator has no valid {', '.join(missing)} any more"
        if self.accuracy_m is not None and self.had_valid:
            if report.accuracy_m is None:
                return "its estimator reports no accuracy of the position any more"
            if report.accuracy_m > max(limits.accuracy_m, WORSE * self.accuracy_m):
                return f"its estimated position is only accurate to {report.accuracy_m:.1f} m"
        if vehicle.age_s(EstimatorReport) > _silent_s(self.reports_hz):
            return "no report of its estimator"
        return ""


def _silent_s(rate_hz: float) -> float:
    return max(SILENT_S, SILENT_MESSAGES / rate_hz) if rate_hz else math.inf


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
        """Drop the jumps so far: those on the ground do not count for the flight."""
        self._jumps.clear()
