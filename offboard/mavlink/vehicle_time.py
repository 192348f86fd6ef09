"""Vehicle time and link time: checks the time stamps of telemetry, and counts seconds that follow
them.

Vehicle time is `time_boot_ms` in seconds, continued when its 32 bits wrap to zero after 49.7 days.
Host time is any monotonic clock and an argument. The age of telemetry and the link delay are in
`flight.timing`.
"""

from __future__ import annotations

from collections import deque
from enum import Enum, auto

# A stamp that is more than _REBOOT_S behind the newest one is late, and one that is more than
# _REBOOT_S ahead is wrong. But at least _EPOCH_STAMPS of them in a row, over at least _EPOCH_S,
# each within _GAP_S of the one before, are a new epoch of the vehicle's clock.
_REBOOT_S = 2.0
_EPOCH_STAMPS, _EPOCH_S, _GAP_S = 3, 0.1, 10.0
# Two clocks alternate if stamps return to the present epoch this often within this time
_TURNS, _TURNS_S = 10, 2.0
SILENCE_S = 1.0  # without telemetry; then `seconds` follows host time
_WRAP_S = 2**32 / 1e3
_NEAR_S = 600.0  # a stamp within this time of the newest one, corrected for the wrap, continues it


class Age(Enum):
    """Whether the time stamp of a message is newer, late or wrong, or the first after a reboot."""

    FRESH = auto()
    STALE = auto()
    REBOOTED = auto()


class VehicleTime:
    """Checks time stamps: the stamps of one message id must increase. A stamp far behind the newest
    one is late, and one far ahead is wrong. Several of them in a row that continue each other are a
    new epoch of the vehicle's clock: a reboot if it is behind the earlier one.

    `newest_s` is the newest stamp of any message. `seconds` is link time: it is monotonic and
    follows vehicle time, or host time while telemetry is missing.
    """

    def __init__(self) -> None:
        self.newest_s = 0.0
        self.seconds = 0.0
        self._last_s: dict[int, float] = {}
        # message id and stamp of messages in a row that may be of a new epoch
        self._other: list[tuple[int, float]] = []
        self._turns_s: deque[float] = deque(maxlen=_TURNS)  # when stamps returned to this epoch
        self._counted_s: float | None = None  # the newest stamp that `seconds` has followed
        # host time of the newest telemetry; before any, of the first call of `on_host`
        self._received_s: float | None = None
        self._bridged_s = 0.0  # host time that `seconds` has counted since the newest telemetry

    # --- stamps ---

    def wrapped_s(self, time_s: float) -> float:
        """Seconds to add to a stamp so that it continues the newest one across the wrap of
        `time_boot_ms`; 0 if the stamp does not continue it, as after a reboot.

        The same offset converts times of the vehicle that do not wrap, as in TIMESYNC, to the time
        of the stamps.
        """
        if not self._last_s:
            return 0.0
        wrapped_s = _WRAP_S * round((self.newest_s - time_s) / _WRAP_S)
        return wrapped_s if abs(time_s + wrapped_s - self.newest_s) < _NEAR_S else 0.0

    def check(self, message_id: int, time_s: float) -> Age:
        """Check and store the stamp `time_s`, to which `wrapped_s` was added already."""
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
        """Whether stamps of two clocks that are more than _REBOOT_S apart alternate."""
        return len(self._turns_s) == _TURNS and self.seconds - self._turns_s[0] < _TURNS_S

    # --- seconds ---

    def on_telemetry(self, time_s: float, now_s: float) -> None:
        """Advance `seconds` for telemetry with the valid stamp `time_s` that arrived at host time
        `now_s`. An older stamp than the newest adds nothing: different messages may arrive out of
        order."""
        self._received_s = now_s
        step_s = 0.0 if self._counted_s is None else time_s - self._counted_s
        if self._counted_s is None or step_s > 0.0 or step_s < -_REBOOT_S:
            self.seconds += max(min(step_s, SILENCE_S) - self._bridged_s, 0.0)
            self._bridged_s = 0.0
            self._counted_s = time_s

    def on_host(self, now_s: float) -> None:
        """Advance `seconds` to host time `now_s` if no telemetry has arrived for SILENCE_S, or none
        yet. All the time since the newest telemetry then counts."""
        if self._received_s is None:
            self._received_s = now_s
        silent_s = now_s - self._received_s
        if self._counted_s is None or silent_s > SILENCE_S:
            self.seconds += max(silent_s - self._bridged_s, 0.0)
            self._bridged_s = max(silent_s, self._bridged_s)
