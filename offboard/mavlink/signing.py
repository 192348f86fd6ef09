"""MAVLink 2 signing without I/O: our signing time, and the check of received signatures. pymavlink
makes the signatures.

A time stamp has 48 bits and counts units of 10 us since 2015-01-01 UTC. Each stream (link id,
system and component) has its own stamps. A received stamp that is newer than our signing time
becomes our signing time, so that computers agree whose clocks were never set.
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
RESERVED = 60 * UNITS_PER_S  # stamps are reserved this far ahead
_STAMP_MAX = (1 << 48) - 1
_HASH_BYTES = 6

# Key in hex, offset of our clock, newest stamp, and (link id, system, component, newest stamp) of
# each stream
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

    Our signing time is at least `offset`, in units of 10 us, plus `clock`, which returns monotonic
    seconds. `reserve` is called with a stamp a minute ahead when less than half a minute of the
    reservation (`reserved`) is left, and always before a stamp beyond it is used. So a caller that
    keeps that stamp knows after a crash which stamps were never used.
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
        """Prepare `sender` to sign the next frame that it packs."""
        sender.signing = self._signing
        self._signing.timestamp = stamp = min(self._now(), _STAMP_MAX)  # pymavlink then adds one
        if stamp > self._reserved - RESERVED // 2:
            self._reserved = stamp + RESERVED
            self._reserve(stamp + RESERVED)

    def refusal(self, frame: Frame, *, note: bool = True) -> Refusal | None:
        """Why a frame must not be used, or None. With `note`, store the time stamp of a frame that
        may be used."""
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
        """Our signing time."""
        newest: int = self._signing.timestamp  # newest stamp that was sent or accepted
        return max(newest, self.offset + int(UNITS_PER_S * self.clock()))

    # --- for another process, which continues the signatures ---

    def state(self) -> State:
        """The state that another process needs to continue the signatures."""
        streams = [(*key, at) for key, at in self._signing.stream_timestamps.items()]
        return self.key.hex(), self.offset, self._signing.timestamp, streams

    @classmethod
    def resumed(cls, clock: Callable[[], float], state: State) -> Signing:
        """Continue from `state`, with stamps a second ahead, because frames may have been sent
        since."""
        key, offset, newest, streams = state
        signing = cls(bytes.fromhex(key), offset + UNITS_PER_S, clock)
        signing._signing.timestamp = newest + UNITS_PER_S
        signing._signing.stream_timestamps = {(a, b, c): at for a, b, c, at in streams}
        return signing
