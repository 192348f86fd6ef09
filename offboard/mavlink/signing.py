"""MAVLink 2 signing: pymavlink signs; here are our own time, the check and its reasons. No I/O.

A time stamp has 48 bits and counts 10 us since 2015-01-01 UTC; its stream is link id, system and
component. A newer stamp than our own time becomes our own time, so that clocks agree that were
never set.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum
from hashlib import sha256
from hmac import compare_digest

from pymavlink.dialects.v20 import all as mavlink

from offboard.mavlink.framing import Frame

UNITS_PER_S = 100_000
EPOCH_UNIX_S = 1_420_070_400  # 2015-01-01 UTC
ALLOWED_UNSIGNED = frozenset({109})  # RADIO_STATUS
LINK_ID = 1
RESERVED = 60 * UNITS_PER_S  # so far the reservation is ahead when it is made
_STAMP_MAX = (1 << 48) - 1
_HASH_BYTES = 6

# Key, offset of our clock, newest stamp, and link id, system, component and newest stamp of each
# stream
State = tuple[str, int, int, list[tuple[int, int, int, int]]]


class Refusal(Enum):
    """Reasons for which signing refuses a frame; the value is the text for the user."""

    UNSIGNED = "no signature"
    BAD_SIGNATURE = "a signature of another key"
    REPLAYED = "a signature whose time stamp is not newer than the last one of its sender"
    OLD_STAMP = "a signature whose time stamp is more than a minute behind"


def stamp_of_unix(unix_us: int) -> int:
    """The time stamp of a Unix time in microseconds; 0 before 2015."""
    return max(0, unix_us // 10 - EPOCH_UNIX_S * UNITS_PER_S)


class Signing:
    """Signs what we send and checks what we receive, with one `key` of 32 bytes.

    `clock` gives monotonic seconds, and `offset` added to it our time in units of 10 us.
    `reserve` is called with a stamp that is about a minute ahead, before a stamp is used that was
    not reserved: who keeps it knows after a crash which stamps were never used.
    """

    def __init__(
        self,
        key: bytes,
        offset: int = 0,
        clock: Callable[[], float] = lambda: 0.0,
        reserve: Callable[[int], object] = lambda stamp: None,
        reserved: float = math.inf,
    ) -> None:
        self.key = key
        self.offset = offset
        self.clock = clock
        self._reserve = reserve
        self._reserved = reserved
        self._signing = mavlink.MAVLink(None).signing
        self._signing.secret_key = key
        self._signing.sign_outgoing = True
        self._signing.link_id = LINK_ID

    def sign(self, sender: mavlink.MAVLink) -> None:
        """Have the next frame that `sender` packs signed."""
        sender.signing = self._signing
        self._signing.timestamp = stamp = min(self._now(), _STAMP_MAX)  # pymavlink then adds one
        if stamp > self._reserved - RESERVED // 2:
            self._reserved = stamp + RESERVED
            self._reserve(stamp + RESERVED)

    def refusal(self, frame: Frame, *, note: bool = True) -> Refusal | None:
        """Why a frame must not be used; notes the time stamp of one that may, if `note`."""
        raw = frame.raw
        if not frame.signed:
            return None if frame.message_id in ALLOWED_UNSIGNED else Refusal.UNSIGNED
        digest = sha256(self.key + raw[:-_HASH_BYTES]).digest()
        if not compare_digest(digest[:_HASH_BYTES], raw[-_HASH_BYTES:]):
            return Refusal.BAD_SIGNATURE
        stream = raw[-13], frame.system_id, frame.component_id
        stamp = int.from_bytes(raw[-12:-6], "little")
        before = self._signing.stream_timestamps.get(stream)
        if before is None and stamp < self._now() - RESERVED:
            return Refusal.OLD_STAMP
        if before is not None and stamp <= before:
            return Refusal.REPLAYED
        if note:
            self._signing.stream_timestamps[stream] = stamp
            self._signing.timestamp = max(self._signing.timestamp, stamp)
        return None

    def _now(self) -> int:
        """Our own time."""
        newest: int = self._signing.timestamp  # of ours, or accepted of others
        return max(newest, self.offset + int(UNITS_PER_S * self.clock()))

    # --- for another process that continues ---

    def state(self) -> State:
        """What another process needs to continue."""
        streams = [(*key, at) for key, at in self._signing.stream_timestamps.items()]
        return self.key.hex(), self.offset, self._signing.timestamp, streams

    @classmethod
    def resumed(cls, clock: Callable[[], float], state: State) -> Signing:
        """Continues `state`, with stamps that are a second ahead: more may have been sent since."""
        key, offset, newest, streams = state
        signing = cls(bytes.fromhex(key), offset + UNITS_PER_S, clock)
        signing._signing.timestamp = newest + UNITS_PER_S
        signing._signing.stream_timestamps = {(a, b, c): at for a, b, c, at in streams}
        return signing
