"""What successive reports of the vehicle show: what its position estimate has lost since the
beginning of the flight, the jumps and drift of this estimate, and the hover thrust.

PX4 continues to follow attitude setpoints when its GPS is lost, and reports a position that drifts
away: by 0.5 m in the first second, 10 m in 15 s. When motion capture is lost, both autopilots
report a valid position for 5 to 7 s more; but the innovation ratios of their estimators repeat
exactly. Only what was there at the beginning can be lost, because a vehicle may fly by motion
capture or optical flow, without GPS.

Jumps are found from the positions: ODOMETRY.reset_counter, which reports them, exists on PX4 only.

Before our setpoints replace the autopilot's own takeoff, or its own mode in the air, the thrust
that it reports (ATTITUDE_TARGET) and the acceleration of the vehicle show the hover thrust,
whatever the vehicle file says and however fast the vehicle climbs.
"""

from __future__ import annotations

import math
import operator
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.estimation.observer import GATES
from offboard.flight.phases import Limits
from offboard.flight.vehicle_state import VehicleState
from offboard.mavlink.events import EstimatorReport, GpsFix, LocalPosition, NoFix, Triple
from offboard.model.axes import acceleration
from offboard.model.vehicle import HOVER_THRUST_LIMITS, Vehicle

Array = NDArray[np.float64]

KNOWN_S = 2.5  # greatest age of a report that counts when the flight begins
SILENT_S, SILENT_MESSAGES = 2.0, 10.0  # time and messages missing: more than a lossy link loses
# An estimator is judged by repeated ratios once it has shown so many different ones in flight.
# Measurements may be SLOWEST_S apart, and the report of one may come MARGIN_S later
MEASUREMENTS_MIN, SLOWEST_S, MARGIN_S = 3, 1.0, 0.5
WORSE = 2.0  # an accuracy that is worse than at the beginning by up to this factor is no loss


@dataclass(slots=True)
class Positioning:
    """What the position estimate had when the flight began, and what of it is lost. Before the
    flight nothing counts as lost."""

    had_fix: bool = False  # which the estimator uses
    report: EstimatorReport | None = None
    without_gps: bool = False  # see `VehicleState.without_gps`
    measured: bool = False  # whether the estimator used GPS or external vision
    measurements: int = 0  # `VehicleState.measurements`
    fixes_silent_s: float = math.inf  # GPS_RAW_INT is missing after this time without a fix
    reports_silent_s: float = math.inf  # the same for EstimatorReport

    def begin(self, vehicle: VehicleState, rates_hz: Mapping[str, float], estimator: str) -> None:
        """Note what there is when the flight begins. `rates_hz` are the rates of the messages that
        arrive, by name; `estimator` is the name of the one that becomes an EstimatorReport."""
        self.without_gps = vehicle.without_gps
        self.had_fix = vehicle.age_s(GpsFix) < KNOWN_S and not self.without_gps
        self.measured = vehicle.unmeasured_s < KNOWN_S
        self.measurements = vehicle.measurements
        self.fixes_silent_s = _silent_s(rates_hz.get("GPS_RAW_INT", 0.0))
        if vehicle.age_s(EstimatorReport) < KNOWN_S:
            self.report = vehicle.estimator
            self.reports_silent_s = _silent_s(rates_hz.get(estimator, 0.0))

    def lost(self, vehicle: VehicleState, limits: Limits) -> str:
        """Which fix or vision is lost, as a sentence; empty if none is."""
        fix_age_s, unmeasured_s = vehicle.age_s(GpsFix), vehicle.unmeasured_s
        if self.had_fix and fix_age_s > limits.gps_s and vehicle.age_s(NoFix) < fix_age_s:
            return f"GPS has no fix for {fix_age_s:.1f} s"
        if self.had_fix and fix_age_s > max(self.fixes_silent_s, limits.gps_s):
            return f"no GPS_RAW_INT for {fix_age_s:.1f} s"
        counted = vehicle.measurements - self.measurements
        measures = self.report and self.measured and counted >= MEASUREMENTS_MIN
        if measures and unmeasured_s > max(limits.gps_s, SLOWEST_S) + MARGIN_S:
            return f"its estimator has used no GPS or external vision for {unmeasured_s:.1f} s"
        return ""

    def invalid(self, vehicle: VehicleState) -> str:
        """What the reports of the estimator have lost, as a sentence; empty if nothing is."""
        before, now = self.report, vehicle.estimator
        if before is None or now is None:
            return ""
        if missing := sorted(before.valid - now.valid):
            return f"its estimator has no valid {', '.join(missing)} any more"
        if before.accuracy_m is not None and before.valid and now.accuracy_m is None:
            return "its estimator reports no accuracy of the position any more"
        silent = vehicle.age_s(EstimatorReport) > self.reports_silent_s
        return "no report of its estimator" if silent else ""

    def inaccurate(self, vehicle: VehicleState, limits: Limits) -> str:
        """How inaccurate the position has become, as a sentence; empty if it has not."""
        before, now = self.report, vehicle.estimator
        if before is None or now is None or before.accuracy_m is None or now.accuracy_m is None:
            return ""
        worse = now.accuracy_m > max(limits.accuracy_m, WORSE * before.accuracy_m)
        sentence = f"its estimated position is only accurate to {now.accuracy_m:.1f} m"
        return sentence if before.valid and worse else ""


def _silent_s(rate_hz: float) -> float:
    return max(SILENT_S, SILENT_MESSAGES / rate_hz) if rate_hz else math.inf


# ---------------------------------------------------------------------- jumps

LEAST_JUMP_M = GATES[0]  # the observer corrects a smaller one as an error
ACCELERATION_MPS2 = 20.0  # greatest acceleration between two reports that their velocities hide
LONGEST_GAP_S = 0.5  # after a longer one nothing is concluded
RECENT_S = 10.0  # see `recent_m`
NOISES = 6.0  # times the mean difference of successive positions: less is noise, not a jump
NOISE_SHARE = 0.01  # weight of the newest difference in this mean
DRIFT_S = 1.0  # time constant; real PX4 drifts by 0.7 m at most, without a fix by 14 m


class PositionJumps:
    """Finds the jumps between successive positions. `drift_m` is the difference between the motion
    by the positions, without jumps, and the motion by the velocities, over the last second.

    The vehicle does not move with a jump. A `place` is a position from which all jumps before it
    are subtracted: places from before and after a jump can be compared."""

    def __init__(self) -> None:
        self._newest: LocalPosition | None = None
        self._jumps: deque[tuple[float, float]] = deque()  # when, by how many metres
        self._noise_m = 0.0  # mean distance of a position from its prediction by the one before
        self._total_ned_m = (0.0, 0.0, 0.0)  # sum of all
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
        north, east, down = jump_m
        self._total_ned_m = self.reported((north, east, down))
        return np.array(jump_m)

    def without(self, reported_ned_m: Triple) -> Triple:
        """Return the place of a position that is reported now."""
        north, east, down = map(operator.sub, reported_ned_m, self._total_ned_m)
        return north, east, down

    def reported(self, place_ned_m: Triple) -> Triple:
        """Return the position that a vehicle at this place would report now."""
        north, east, down = map(operator.add, place_ned_m, self._total_ned_m)
        return north, east, down

    def recent_m(self, time_s: float) -> float:
        """Sum of the sizes of the jumps in the last RECENT_S."""
        while self._jumps and self._jumps[0][0] < time_s - RECENT_S:
            self._jumps.popleft()
        return sum(size_m for _, size_m in self._jumps)

    def forget(self) -> None:
        """Forget the jumps so far, because those on the ground do not count for the flight."""
        self._jumps.clear()


# ---------------------------------------------------------------------- hover thrust

WINDOW_S, KEPT_S = 0.5, 1.5  # see `HoverEstimate`
GROUND_M = 0.2  # below this height the ground may carry the vehicle
LEAST_THRUSTS, LEAST_SPEEDS, LEAST_S = 3, 4, 0.25  # in the window; 10 Hz must suffice
LEAST_LIFT = 0.3  # of the weight: less lift shows too little of the thrust


class HoverEstimate:
    """The hover thrust, from the reported thrust and the vertical speed of the last KEPT_S."""

    def __init__(self) -> None:
        self._thrusts: deque[tuple[float, ...]] = deque()  # time, thrust, its vertical part
        self._speeds: deque[tuple[float, ...]] = deque()  # time, speed down

    def on_thrust(self, time_s: float, thrust: float, lift: float) -> None:
        """Take the collective thrust that the autopilot reports, 0 .. 1; `lift` is its vertical
        part."""
        _append(self._thrusts, (time_s, thrust, lift))

    def on_position(self, time_s: float, height_m: float, down_mps: float) -> None:
        """Take the height above the ground, and the vertical velocity, positive down."""
        if height_m < GROUND_M:
            self._speeds.clear()
            return
        _append(self._speeds, (time_s, down_mps))

    def thrust(self, time_s: float) -> float | None:
        """Mean of the thrust that was reported in the WINDOW_S before `time_s`, or None."""
        thrusts = _within(self._thrusts, time_s - WINDOW_S, time_s)
        return float(np.mean(thrusts[:, 1])) if len(thrusts) else None

    def hover_thrust(self, vehicle: Vehicle, time_s: float) -> float | None:
        """The hover thrust (normalised), from the WINDOW_S before `time_s`; None if too little was
        reported in it, or the vehicle falls. Delay, lag and drag are those of `vehicle`:
        a_down = g (1 - u_lift / u_h) - c v_down."""
        speeds = _within(self._speeds, time_s - WINDOW_S, time_s)
        if len(speeds) < LEAST_SPEEDS or speeds[-1, 0] - speeds[0, 0] < LEAST_S:
            return None
        response_s = vehicle.thrust_delay_s + vehicle.thrust_lag_s
        thrusts = _within(self._thrusts, speeds[0, 0] - response_s, time_s - response_s)
        if len(thrusts) < LEAST_THRUSTS:
            return None
        gravity_mps2 = vehicle.gravity_mps2
        a_down_mps2 = float(np.polyfit(speeds[:, 0] - time_s, speeds[:, 1], 1)[0])
        down_mps = float(np.mean(speeds[:, 1]))
        # solved for the thrust
        lift_mps2 = acceleration(gravity_mps2, a_down_mps2, vehicle.drag_per_mass_ps, down_mps, 0.0)
        if lift_mps2 < LEAST_LIFT * gravity_mps2:
            return None
        share = float(np.mean(thrusts[:, 2])) * gravity_mps2 / lift_mps2
        return share if HOVER_THRUST_LIMITS[0] <= share <= HOVER_THRUST_LIMITS[1] else None


def _append(samples: deque[tuple[float, ...]], sample: tuple[float, ...]) -> None:
    samples.append(sample)
    while samples[0][0] < sample[0] - KEPT_S:
        samples.popleft()


def _within(samples: deque[tuple[float, ...]], begin_s: float, end_s: float) -> Array:
    kept = [each for each in samples if begin_s <= each[0] <= end_s]
    return np.array(kept, dtype=np.float64)
