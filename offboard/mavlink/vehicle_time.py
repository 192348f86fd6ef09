"""Time stamps of telemetry, judged one by one. Knows no message but by its id."""

from __future__ import annotations

from enum import Enum, auto

_REORDERING_S = 2.0  # older than this against the newest is a reboot, not a late packet


class Age(Enum):
    """Of a message, by its time stamp."""

    FRESH = auto()
    STALE = auto()
    REBOOTED = auto()


class VehicleTime:
    """Judges time stamps: each message's must rise, and none may lie far behind the newest."""

    def __init__(self) -> None:
        self.newest_s = 0.0
        self._last_s: dict[int, float] = {}

    def judge(self, message_id: int, time_s: float) -> Age:
        if time_s < self.newest_s - _REORDERING_S:
            self.newest_s = time_s
            self._last_s = {message_id: time_s}
            return Age.REBOOTED
        last_s = self._last_s.get(message_id)
        if last_s is not None and time_s <= last_s:
            return Age.STALE
        self._last_s[message_id] = time_s
        if time_s > self.newest_s:
            self.newest_s = time_s
        return Age.FRESH
