"""Monitors: events that nobody requests (ground station, battery, position, automatic disarming).

Time limits are parameters of the firmware; its state table decides what an event does.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from simulator.autopilot.parameters import ParameterTable
from simulator.firmware.base import Firmware
from simulator.vehicle.battery import BatteryState

MONITOR_STEPS = 25  # 0.1 s


@dataclass(slots=True)
class Monitors:
    """Ground station, battery and position; each event is reported once."""

    firmware: Firmware
    parameters: ParameterTable
    ground_station_lost: bool = False
    position_lost: bool = False
    _heartbeat_s: float = math.nan  # last one of a ground station
    _battery_level: int = 0  # reported; of `firmware.health.battery_events`
    _worse_s: float = math.nan  # since when the level is above that
    _fix_s: float = -math.inf  # last one

    def ground_station_heard(self, now_s: float) -> None:
        self._heartbeat_s = now_s

    def without_fix_s(self, now_s: float) -> float:
        """Time since the last GPS fix."""
        return now_s - self._fix_s

    def step(self, now_s: float, armed: bool, battery: BatteryState, has_fix: bool) -> list[str]:
        """Events since the last step."""
        if has_fix:
            self._fix_s = now_s
        return [
            *self._ground_station(now_s),
            *self._battery(now_s, armed, battery),
            *self._position(now_s),
        ]

    def _ground_station(self, now_s: float) -> Iterator[str]:
        """A ground station that was never heard is not lost."""
        timeout_s = self.parameters.role("ground_station_timeout_s")
        timeout_s += self.firmware.link.ground_station_stays_s
        lost = now_s - self._heartbeat_s > timeout_s
        if lost != self.ground_station_lost:
            self.ground_station_lost = lost
            yield "ground station lost" if lost else "ground station found"

    def _battery(self, now_s: float, armed: bool, battery: BatteryState) -> Iterator[str]:
        """A level is reported when it lasts; in flight it only gets worse."""
        level = 0
        if armed:
            level = self.firmware.health.battery_level(battery, self.parameters.__getitem__)
        else:
            self._battery_level = 0
        if level <= self._battery_level:
            self._worse_s = math.nan
            return
        if math.isnan(self._worse_s):
            self._worse_s = now_s
        if now_s - self._worse_s >= self.parameters.role("battery_patience_s"):
            self._battery_level, self._worse_s = level, math.nan
            yield self.firmware.health.battery_events[level - 1]

    def _position(self, now_s: float) -> Iterator[str]:
        lost = now_s - self._fix_s > self.firmware.health.position_without_fix_s
        if lost != self.position_lost:
            self.position_lost = lost
            yield "position lost" if lost else "position found"


@dataclass(slots=True)
class FlightTime:
    """Takeoff and landing of an armed vehicle, and when it disarms by itself."""

    parameters: ParameterTable
    _flown: bool = False
    _armed_s: float = -math.inf
    _landed_s: float = -math.inf

    def arm(self, now_s: float, landed: bool) -> None:
        self._flown, self._armed_s = not landed, now_s

    def step(self, now_s: float, was_landed: bool, landed: bool) -> Iterator[str]:
        """The event of leaving or reaching the ground."""
        if was_landed and not landed:
            self._flown = True
            yield "took off"
        if landed and not was_landed:
            self._landed_s = now_s
            yield "landed"

    def timeout(self, now_s: float, landed: bool) -> Iterator[str]:
        """The event of a vehicle that stays on the ground, after a flight or without one."""
        event, since_s, role = "idle", self._armed_s, "disarm_idle_s"
        if self._flown:
            event, since_s, role = "settled", self._landed_s, "disarm_landed_s"
        limit_s = self.parameters.role(role)
        if landed and limit_s > 0 and now_s - since_s >= limit_s - 1e-6:
            yield event
