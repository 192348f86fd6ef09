"""Vehicle time: which time stamps of telemetry are valid, and the seconds that the session counts.

Vehicle time is `time_boot_ms` in seconds, continued where its 32 bits begin again at zero, after
49.7 days. Host time is any monotonic clock, given as an argument. How old telemetry is, and how
late the link, is in `flight.timing`.
"""

from __future__ import annotations

from collections import deque
from enum import Enum, auto

# Stamps older than the newest by more than _REBOOT_S are late, and those ahead of it by more are
# wrong, unless they go on so: so many in a row, over so long, each within _GAP_S of the one before,
# are a new epoch
_REBOOT_S = 2.0
_EPOCH_STAMPS, _EPOCH_S, _GAP_S = 3, 0.1, 10.0
# So often within this time a stamp of this epoch follows one of another: two clocks alternate
_TURNS, _TURNS_S = 10, 2.0
SILENCE_S = 1.0
_WRAP_S = 2**32 / 1e3
_NEAR_S = 600.0  # a stamp this close to the newest, also but for the wrap, continues it


class Age(Enum):
    """What the time stamp of a message means."""

    FRESH = auto()
    STALE = auto()
    REBOOTED = auto()


class VehicleTime:
    """Checks time stamps: those of one message id must increase. One that is far behind the newest
    is late, one far ahead is wrong; several of them in a row that go on from each other are a new
    epoch, a reboot if it is behind.

    `newest_s` is the newest stamp of any message. `seconds` are monotonic and follow vehicle time,
    or host time while telemetry is missing.
    """

    def __init__(self) -> None:
        self.newest_s = 0.0
        self.seconds = 0.0
        self._last_s: dict[int, float] = {}
        self._other: list[tuple[int, float]] = []  # of another epoch, in a row: id and stamp
        self._turns_s: deque[float] = deque(maxlen=_TURNS)  # when this epoch followed another
        self._counted_s: float | None = None  # the newest stamp that `seconds` has followed
        self._received_s: float | None = None  # host time of the newest telemetry, or the first
        self._bridged_s = 0.0  # counted since the newest telemetry

    # --- stamps ---

    def wrapped_s(self, time_s: float) -> float:
        """Seconds to add to a stamp to continue the newest one across the wrap of `time_boot_ms`;
        0 where it is no continuation, as after a reboot.

        Also for clocks of the vehicle that do not wrap, as in TIMESYNC: puts them on that of the
        stamps.
        """
        if not self._last_s:
            return 0.0
        wrapped_s = _WRAP_S * round((self.newest_s - time_s) / _WRAP_S)
        return wrapped_s if abs(time_s + wrapped_s - self.newest_s) < _NEAR_S else 0.0

    def check(self, message_id: int, time_s: float) -> Age:
        """`time_s`: the stamp, continued by `wrapped_s`."""
        last_s = self._last_s.get(message_id)
        if self._last_s and abs(time_s - self.newest_s) > _REBOOT_S:
            stuck = time_s == last_s
            return Age.STALE if stuck else self._check_epoch(message_id, time_s)
        if self._other:
            self._turns_s.append(self.seconds)
        self._other.clear()
        if last_s is not None and time_s <= last_s:
            return Age.STALE
        self._last_s[message_id] = time_s
        self.newest_s = max(self.newest_s, time_s)
        return Age.FRESH

    def _check_epoch(self, message_id: int, time_s: float) -> Age:
        repeated = any(each == message_id and time_s <= at_s for each, at_s in self._other)
        if repeated or (self._other and abs(time_s - self._other[-1][1]) > _GAP_S):
            self._other.clear()
        self._other.append((message_id, time_s))
        if len(self._other) < _EPOCH_STAMPS or time_s - self._other[0][1] < _EPOCH_S:
            return Age.STALE
        rebooted = time_s < self.newest_s
        self._last_s = dict(self._other)
        self.newest_s = max(self._last_s.values())
        self._other.clear()
        return Age.REBOOTED if rebooted else Age.FRESH

    @property
    def mixed(self) -> bool:
        """Whether stamps of two clocks, more than _REBOOT_S apart, alternate."""
        return len(self._turns_s) == _TURNS and self.seconds - self._turns_s[0] < _TURNS_S

    # --- seconds ---

    def on_telemetry(self, time_s: float, now_s: float) -> None:
        """Telemetry with the valid stamp `time_s` arrived at host time `now_s`. A stamp older than
        the newest adds nothing: messages of several streams may arrive out of order."""
        self._received_s = now_s
        step_s = 0.0 if self._counted_s is None else time_s - self._counted_s
        if self._counted_s is None or step_s > 0.0 or step_s < -_REBOOT_S:
            self.seconds += max(min(step_s, SILENCE_S) - self._bridged_s, 0.0)
            self._bridged_s = 0.0
            self._counted_s = time_s

    def on_host(self, now_s: float) -> None:
        """Host time is `now_s`; once no telemetry has arrived for a second, all the time since the
        newest counts."""
        if self._received_s is None:
            self._received_s = now_s
        silent_s = now_s - self._received_s
        if self._counted_s is None or silent_s > SILENCE_S:
            self.seconds += max(silent_s - self._bridged_s, 0.0)
            self._bridged_s = max(silent_s, self._bridged_s)
