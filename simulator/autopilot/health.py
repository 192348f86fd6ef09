"""Boot events, pre-arm checks, and the events that nobody requests: of ground station, battery,
position, takeoff, landing and automatic disarming.

The firmware defines time limits; its state table decides what an event does and what is refused.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from simulator.autopilot.guidance import Guidance
from simulator.autopilot.values import Behaviour, Mode
from simulator.vehicle.conditions import BatteryState

MONITOR_STEPS = 25  # 0.1 s


class Health:
    """Health of one vehicle from boot on; `boot_scale` multiplies the times of the boot events.

    It monitors ground station, battery and position, and reports each event once. It also reports
    takeoff, landing, and an armed vehicle that stays on the ground. Times are seconds since boot.
    """

    def __init__(self, guidance: Guidance, boot_scale: float) -> None:
        self._firmware = firmware = guidance.firmware
        self._guidance, self._parameters = guidance, guidance.parameters
        self.boot_scale = boot_scale
        self.reached: frozenset[str] = frozenset()  # boot events so far
        times_s = firmware.boot_events_s.items()
        self._ahead = sorted((at_s * boot_scale, event) for event, at_s in times_s)
        self.ground_station_lost = False
        self.position_lost = False  # for lack of a GPS fix
        self.sticks_lost = not guidance.sticks.present(0.0)
        self._heartbeat_s = math.nan  # time of the last one from a ground station
        self._battery_level = 0  # last level that was reported (`Firmware.battery_level`)
        self._worse_s = math.nan  # time since which the level is greater than that
        self._fix_s = -math.inf  # time of the last GPS fix
        self.took_off_s = 0.0  # time of the last takeoff since arming, 0: none
        self.armed_s = self._landed_s = -math.inf

    # -- events ------------------------------------------------------------------------------

    def boot_events(self, now_s: float) -> Iterator[str]:
        """Boot events since the last call."""
        while self._ahead and now_s >= self._ahead[0][0]:
            _, event = self._ahead.pop(0)
            self.reached |= {event}
            yield event

    def monitor(
        self, now_s: float, armed: bool, battery: BatteryState, has_fix: bool
    ) -> Iterator[str]:
        """Events of ground station, battery and position since the last call."""
        if has_fix:
            self._fix_s = now_s
        yield from self._ground_station(now_s)
        yield from self._battery(now_s, armed, battery)
        yield from self._sticks(now_s)
        lost = self.without_fix_s(now_s) > self._parameters.role("position_without_fix_s")
        if lost != self.position_lost:
            self.position_lost = lost
            yield "position lost" if lost else "position found"

    def _ground_station(self, now_s: float) -> Iterator[str]:
        """Event of a lost or found ground station. One that was never heard is not lost."""
        role = self._parameters.role
        timeout_s = role("ground_station_timeout_s") + role("ground_station_stays_s")
        lost = now_s - self._heartbeat_s > timeout_s
        if lost != self.ground_station_lost:
            self.ground_station_lost = lost
            yield "ground station lost" if lost else "ground station found"

    def _sticks(self, now_s: float) -> Iterator[str]:
        """Event of lost or found stick input."""
        lost = not self._guidance.sticks.present(now_s)
        if lost != self.sticks_lost:
            self.sticks_lost = lost
            yield "sticks lost" if lost else "sticks found"

    def _battery(self, now_s: float, armed: bool, battery: BatteryState) -> Iterator[str]:
        """Event of a battery level, when it has lasted. While the vehicle is armed, only a level
        greater than the last one is reported."""
        level = 0
        if armed:
            level = self._firmware.battery_level(battery, self._parameters)
        else:
            self._battery_level = 0
        if level <= self._battery_level:
            self._worse_s = math.nan
            return
        if math.isnan(self._worse_s):
            self._worse_s = now_s
        if now_s - self._worse_s >= self._parameters.role("battery_patience_s"):
            self._battery_level, self._worse_s = level, math.nan
            yield self._firmware.battery_events[level - 1]

    def arm(self, now_s: float, landed: bool) -> None:
        """Note that the motors start, on the ground or in the air."""
        self.took_off_s, self.armed_s = 0.0 if landed else now_s, now_s

    def flight(self, now_s: float, was_landed: bool, landed: bool) -> Iterator[str]:
        """Events of takeoff and landing of an armed vehicle."""
        if was_landed and not landed:
            self.took_off_s = now_s
            yield "took off"
        if landed and not was_landed:
            self._landed_s = now_s
            yield "landed"

    def timeout(self, now_s: float, landed: bool) -> Iterator[str]:
        """Event of an armed vehicle that stays on the ground: "settled" after a flight, otherwise
        "idle"."""
        if not landed:
            return
        event, since_s, role = "idle", self.armed_s, "disarm_idle_s"
        if self.took_off_s:
            event, since_s, role = "settled", self._landed_s, "disarm_landed_s"
        limit_s = self._parameters.role(role)
        if limit_s > 0 and now_s - since_s >= limit_s - 1e-6:
            yield event

    # -- state -------------------------------------------------------------------------------

    def ground_station_heard(self, now_s: float) -> None:
        self._heartbeat_s = now_s

    def without_fix_s(self, now_s: float) -> float:
        """Time since the last GPS fix."""
        return now_s - self._fix_s

    def position_ratio(self, mean: float) -> float:
        """Innovation test ratio of the horizontal position: it changes with each GPS measurement,
        and repeats without a fix."""
        return mean * (1.0 + 0.1 * math.sin(self._fix_s)) if math.isfinite(self._fix_s) else mean

    def passes(self, mode: Mode, now_s: float, *, latched: bool, armed: bool) -> bool:
        """Whether the pre-arm checks pass in this mode. `latched`: whether there is a failure that
        only a reboot clears."""
        firmware = self._firmware
        ready = "ready" if mode.needs_position else "ready without position"
        if latched or ready not in self.reached or (mode.needs_position and self.position_lost):
            return False
        if firmware.fails_where_unarmable and not (mode.arms or armed):
            return False
        heard = not (self.ground_station_lost or math.isnan(self._heartbeat_s))
        if self._parameters.role("ground_station_needed") > 0 and not heard:
            return False
        if mode.needs_sticks and not (self._flies_by_sticks(mode) or armed):
            return False
        if mode.behaviour is Behaviour.MISSION:
            return self._guidance.mission.flyable
        needs_stream = mode.behaviour is Behaviour.SETPOINT and not firmware.ardupilot_setpoints
        return not needs_stream or self._guidance.stream_alive(now_s)

    def can_run(self, mode: Mode, now_s: float) -> bool:
        """Whether an armed vehicle may enter this mode."""
        if mode.behaviour is Behaviour.SETPOINT:
            return self._guidance.stream_alive(now_s)
        if mode.behaviour is Behaviour.MISSION:
            return self._guidance.mission.flyable
        return not mode.needs_sticks or self._flies_by_sticks(mode)

    def _flies_by_sticks(self, mode: Mode) -> bool:
        """Whether a mode that needs sticks has them; the modes without position control are not
        simulated."""
        return mode.behaviour is Behaviour.STICKS and not self.sticks_lost
