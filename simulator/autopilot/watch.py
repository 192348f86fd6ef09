"""What happens to a vehicle by itself: ground station, battery and position lost and found.

Knows how long and how low by the firmware's parameters; what is done about it is for the rules.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from simulator.autopilot.parameters import ParameterTable
from simulator.firmware.base import Firmware
from simulator.vehicle.battery import BatteryState

EVERY_STEPS = 25  # 0.1 s


@dataclass(slots=True)
class Watch:
    """Tells once of what changes by itself: ground station, battery, estimate."""

    firmware: Firmware
    parameters: ParameterTable
    _ground_station_s: float = math.nan  # last heard
    _ground_station_lost: bool = False
    _battery_level: int = 0  # of `firmware.health.battery_events`, already told
    _worse_s: float = math.nan  # since when it is worse than that
    _fix_s: float = 0.0
    _position_lost: bool = False

    def hear_ground_station(self, now_s: float) -> None:
        self._ground_station_s = now_s

    @property
    def ground_station_lost(self) -> bool:
        return self._ground_station_lost

    @property
    def position_lost(self) -> bool:
        return self._position_lost

    def step(self, now_s: float, armed: bool, battery: BatteryState, has_fix: bool) -> list[str]:
        """Events since the last step."""
        return [
            *self._ground_station(now_s),
            *self._battery(now_s, armed, battery),
            *self._position(now_s, has_fix),
        ]

    @property
    def _patience_s(self) -> float:
        """From a ground station's last heartbeat until it is lost."""
        timeout_s = self.parameters.role("ground_station_timeout_s")
        return timeout_s + self.firmware.link.ground_station_stays_s

    def _silent(self, now_s: float) -> bool:
        """The ground station has been for too long; never heard is not lost."""
        return now_s - self._ground_station_s > self._patience_s

    def _level(self, battery: BatteryState) -> int:
        return self.firmware.health.battery_level(battery, self.parameters.__getitem__)

    def _ground_station(self, now_s: float) -> list[str]:
        lost = self._silent(now_s)
        if lost == self._ground_station_lost:
            return []
        self._ground_station_lost = lost
        return ["ground station lost" if lost else "ground station found"]

    def _battery(self, now_s: float, armed: bool, battery: BatteryState) -> list[str]:
        """It only gets worse in flight, and is believed to when it stays so for a while."""
        if not armed:
            self._battery_level, self._worse_s = 0, math.nan
            return []
        level = self._level(battery)
        if level <= self._battery_level:
            self._worse_s = math.nan
            return []
        if math.isnan(self._worse_s):
            self._worse_s = now_s
        if now_s - self._worse_s < self.parameters.role("battery_patience_s"):
            return []
        self._battery_level, self._worse_s = level, math.nan
        return [self.firmware.health.battery_events[level - 1]]

    def _position(self, now_s: float, has_fix: bool) -> list[str]:
        if has_fix:
            self._fix_s = now_s
        lost = now_s - self._fix_s > self.firmware.health.position_without_fix_s
        if lost == self._position_lost:
            return []
        self._position_lost = lost
        return ["position lost" if lost else "position found"]
