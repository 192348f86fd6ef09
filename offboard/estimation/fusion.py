"""Own position fusion (`estimate: fused`): position from GPS fixes and the vehicle's motion instead
of the one that the vehicle reports, which on PX4 is wrong by half a metre for seconds.

This module chooses between the two and changes over smoothly. The vehicle's estimate is used on the
ground and whenever fixes end, jump or contradict it; meanwhile its offset from the fixes is
estimated. The result is always finite.
"""

from __future__ import annotations

import math
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from offboard.estimation.fusion_filter import GATE_SDS, FusionFilter, FusionSettings, Past
from offboard.estimation.observer import Observer, ObserverSettings, Quaternion, Triple
from offboard.model.command import Command
from offboard.model.frames import thrust_direction_from_quaternion
from offboard.model.geodesy import Geodetic, origin_of, position_ned_m
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]

SILENT_S = 1.0  # after this time without a usable fix or attitude the vehicle's estimate is used
AHEAD_S = 0.5  # a stamp further ahead of telemetry is of another clock
LEAST_FIXES = 16  # before fusion begins: two seconds
SMOOTH_S = 0.25  # time constant over which the correction by a fix is applied
WANDER_MPS = 0.1  # drift of the vehicle's estimate, m per root second
UNKNOWN_M2 = 25.0  # variance of the offset before the first fix


class FollowedEstimate(StrEnum):
    """Which position estimate the controller follows."""

    VEHICLE = "vehicle"
    FUSED = "fused"


class DecayingOffset:
    """An offset (n,) that decays with a time constant, so that a change is applied smoothly."""

    def __init__(self, size: int, time_constant_s: float) -> None:
        self.time_constant_s = time_constant_s
        self._left = np.zeros(size)
        self._from_s = 0.0

    def set(self, left: Array, time_s: float) -> None:
        self._left, self._from_s = left, time_s

    def add(self, more: Array, time_s: float) -> None:
        self.set(self.at(time_s) + more, time_s)

    def at(self, time_s: float) -> Array:
        """The offset that is left at `time_s`."""
        past_s = max(time_s - self._from_s, 0.0)
        left: Array = self._left * math.exp(-past_s / self.time_constant_s)
        return left


class Offset:
    """Offset (NED) of the fixes from the vehicle's estimate, while that is followed."""

    def __init__(self, settings: FusionSettings) -> None:
        sds = settings.position_sd_m, settings.position_sd_m, settings.height_sd_m
        self._noise_m2 = np.square(sds)
        self.forget()

    def forget(self) -> None:
        self.value_m = np.zeros(3)
        self.variance_m2 = np.full(3, UNKNOWN_M2)
        self.fixes = 0
        self._at_s = math.nan

    def learn(self, time_s: float, off_m: Array) -> None:
        """Update by the offset of one fix; restart if it is further than GATE_SDS standard
        deviations from the estimated offset."""
        if self.fixes:
            self.variance_m2 += WANDER_MPS**2 * max(time_s - self._at_s, 0.0)
            spread = np.sqrt(self.variance_m2 + self._noise_m2)
            if (np.abs(off_m - self.value_m) > GATE_SDS * spread).any():
                self.forget()
        gain = self.variance_m2 / (self.variance_m2 + self._noise_m2)
        self.value_m = self.value_m + gain * (off_m - self.value_m)
        self.variance_m2 = (1.0 - gain) * self.variance_m2
        self.fixes += 1
        self._at_s = time_s


class Fusion:
    """Own position fusion of one flight. `news` collects sentences for the user; the reader empties
    it."""

    def __init__(self, vehicle: Vehicle, settings: FusionSettings) -> None:
        self._settings = settings
        self._filter = FusionFilter(vehicle, settings)
        self._offset = Offset(settings)
        self.news: list[str] = []
        self.reset()

    def reset(self) -> None:
        """Forget everything, after a restart of the vehicle."""
        self.fused = False
        self._grounded = True
        self._origin: Geodetic | None = None
        self._origin_from_vehicle = self._announced = False
        self._stamp_s = self._fixed_s = -math.inf
        self._reported = Past()
        self._reported_s = -math.inf
        self._handover = DecayingOffset(3, self._settings.handover_s)
        self._smooth = DecayingOffset(6, SMOOTH_S)
        self._followed: tuple[Array, Array] | None = None
        self._received: tuple[Triple, Triple] | None = None  # the newest that was followed
        self._offset.forget()

    def adopt(self, vehicle: Vehicle) -> None:
        self._filter.adopt(vehicle)

    def freeze(self, grounded: bool) -> None:
        """Use the vehicle's estimate while it is on the ground or does not fly our commands."""
        self._grounded = grounded
        if grounded and self.fused:
            self._use_vehicle("the vehicle does not fly our commands")

    def on_command(self, time_s: float, command: Command) -> None:
        self._filter.on_command(time_s, command.thrust_mps2)

    def on_attitude(self, time_s: float, q: Quaternion) -> None:
        if not self.fused:
            return
        if time_s - self._filter.time_s > SILENT_S:
            self._use_vehicle(f"no attitude for {SILENT_S:.0f} s")
        else:
            self._filter.on_attitude(time_s, np.array(thrust_direction_from_quaternion(q)))

    def on_origin(self, place: Geodetic, from_vehicle: bool) -> None:
        """Origin of the local frame. One `from_vehicle` replaces a computed one."""
        if from_vehicle or not self._origin_from_vehicle:
            self._origin, self._origin_from_vehicle = place, from_vehicle

    def on_fix(
        self,
        time_s: float | None,
        place: Geodetic,
        velocity_ne_mps: tuple[float, float] | None,
        accuracy_m: float | None,
    ) -> None:
        """A GPS fix at `place`, with velocity (north, east) and accuracy if the receiver has them.
        `time_s` is its stamp; without one, or with that of another clock, it is of now."""
        now_s = self._reported_s
        stamp_s = now_s if time_s is None or time_s > now_s + AHEAD_S else time_s
        if stamp_s <= self._stamp_s or not math.isfinite(stamp_s):
            return
        self._stamp_s = stamp_s
        then_s = stamp_s - self._settings.delay_s
        reported = self._reported.at(then_s)
        if reported is None or (accuracy_m or 0.0) > self._settings.accuracy_m:
            return
        if self._origin is None:
            self._origin = origin_of(place, _triple(reported))
        position = np.array(position_ned_m(place, self._origin))
        if not self.fused:
            self._offset.learn(then_s, position - reported)
            self._fixed_s = stamp_s
            return
        change = self._filter.correct(then_s, position, velocity_ne_mps)
        if change is not None:
            self._fixed_s = stamp_s
            self._smooth.add(-change.T.ravel(), self._filter.time_s)

    def follow(self, time_s: float, position: Triple, velocity: Triple) -> tuple[Triple, Triple]:
        """Position and velocity (NED) to follow, given those that the vehicle reports. While these
        do not change although it moves, its estimate stands still, and so does the result."""
        if self._followed and any(velocity) and (position, velocity) == self._received:
            return _triple(self._followed[0]), _triple(self._followed[1])
        self._received = position, velocity
        reported, speed = np.array(position), np.array(velocity)
        if time_s > self._reported_s:
            self._reported_s = time_s
            self._reported.note(time_s, reported)
        self._choose(time_s, reported, speed)
        here, moving = self._filter.at(time_s) if self.fused else (reported, speed)
        smooth, handover = self._smooth.at(time_s), self._handover.at(time_s)
        followed = (
            here + smooth[:3] + handover,
            moving + smooth[3:] - handover / self._handover.time_constant_s,
        )
        if not (np.isfinite(followed[0]).all() and np.isfinite(followed[1]).all()):
            self.reset()
            self.news.append("own position fusion is not finite: using the vehicle's estimate")
            return position, velocity
        self._followed = followed
        return _triple(followed[0]), _triple(followed[1])

    def _choose(self, time_s: float, reported: Array, speed: Array) -> None:
        apart_m = self._settings.disagreement_m
        if self.fused:
            off_m = float(np.abs(self._filter.at(time_s)[0] - reported).max())
            if time_s - self._fixed_s > SILENT_S:
                self._use_vehicle(f"no usable GPS fix for {SILENT_S:.0f} s")
            elif off_m > apart_m:
                self._use_vehicle(f"GPS and the vehicle's estimate are {off_m:.1f} m apart")
            return
        if self._grounded or self._offset.fixes < LEAST_FIXES:
            return
        if time_s - self._fixed_s > SILENT_S:
            self._offset.forget()
            return
        off_m = float(np.abs(self._offset.value_m).max())
        if off_m <= apart_m:
            self._use_fusion(time_s, reported, speed)
        elif not self._announced:
            self._announced = True
            self.news.append(f"GPS is {off_m:.1f} m from the vehicle's estimate: not fused")

    def _use_fusion(self, time_s: float, reported: Array, speed: Array) -> None:
        offset = self._offset
        variances = float(offset.variance_m2[0]), float(offset.variance_m2[2])
        self._filter.start(time_s, reported + offset.value_m, speed, variances)
        self._handover.add(-offset.value_m, time_s)
        self.fused, self._announced = True, False
        off_m = float(np.linalg.norm(offset.value_m))
        self.news.append(f"own position fusion in use, {off_m:.2f} m from the vehicle's estimate")

    def _use_vehicle(self, reason: str) -> None:
        """Change over to the vehicle's estimate."""
        self.fused = False
        self._offset.forget()
        at_s, reported = self._reported_s, self._reported.at(self._reported_s)
        if self._followed is not None and reported is not None:
            self._handover.set(self._followed[0] - reported, at_s)
            self._smooth.set(np.zeros(6), at_s)
        self.news.append(f"{reason}: using the vehicle's estimate")


def _triple(values: Array) -> Triple:
    north, east, down = values.tolist()
    return north, east, down


class FusedObserver(Observer):
    """An observer that follows the position of `fusion`, which the caller applies to each position
    message."""

    def __init__(
        self, vehicle: Vehicle, settings: ObserverSettings, fusion: FusionSettings
    ) -> None:
        self.fusion = Fusion(vehicle, fusion)
        super().__init__(vehicle, settings)

    def reset(self) -> None:
        super().reset()
        self.fusion.reset()

    def adopt(self, vehicle: Vehicle) -> None:
        super().adopt(vehicle)
        self.fusion.adopt(vehicle)

    def freeze(self, grounded: bool) -> None:
        super().freeze(grounded)
        self.fusion.freeze(grounded)

    def on_command(self, time_s: float, command: Command) -> None:
        super().on_command(time_s, command)
        self.fusion.on_command(time_s, command)

    def on_attitude(self, time_s: float, q: Quaternion, rates: Triple) -> None:
        super().on_attitude(time_s, q, rates)
        self.fusion.on_attitude(time_s, q)


def observer_of(
    estimate: FollowedEstimate, vehicle: Vehicle, settings: ObserverSettings, fusion: FusionSettings
) -> Observer:
    """The observer that follows the position `estimate`."""
    if estimate is FollowedEstimate.FUSED:
        return FusedObserver(vehicle, settings, fusion)
    return Observer(vehicle, settings)
