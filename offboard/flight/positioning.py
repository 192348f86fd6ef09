"""Positioning: what the vehicle's estimate was made of when the flight began, and has lost since.

PX4 goes on under attitude setpoints when its GPS is lost, and reports a position that drifts away:
0.5 m in the first second, 10 m in fifteen. What was not there at the beginning is not missed: a
vehicle may fly by motion capture or optical flow.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from offboard.flight.phases import Limits
from offboard.flight.vehicle_state import VehicleState
from offboard.mavlink.events import EstimatorReport, GpsFix, NoFix

KNOWN_S = 2.5  # age of a report that counts when the flight begins
SILENT_S, SILENT_MESSAGES = 2.0, 10.0  # missing in a row: no loss of the link
WORSE = 2.0  # times the accuracy of the beginning, where that was no better than the limit


@dataclass(slots=True)
class Positioning:
    """What was there when the flight began; nothing before it."""

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
