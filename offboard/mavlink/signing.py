"""MAVLink 2 signing: signatures made and checked, and their time stamps. No I/O.

The signature of a frame is its link id (one byte), a time stamp (48 bits, units of 10 us since
2015-01-01 UTC) and the first six bytes of SHA-256 over key, frame, link id and time stamp.

A stamp must be newer than the last one accepted of the same stream, which is system, component and
link id; that of a new stream may be at most a minute behind our own time. A newer stamp than our
own time becomes our own time, so that clocks agree that were never set. Our own time follows a
monotonic clock: it does not go back when the computer's clock does.

Nothing is accepted unsigned, except RADIO_STATUS, which telemetry radios insert.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from hashlib import sha256
from hmac import compare_digest
from typing import Any

from offboard.mavlink.counters import DropReason
from offboard.mavlink.framing import Frame

UNITS_PER_S = 100_000
EPOCH_UNIX_S = 1_420_070_400  # 2015-01-01 UTC
BEHIND_MAX = 60 * UNITS_PER_S
ALLOWED_UNSIGNED = frozenset({109})  # RADIO_STATUS
LINK_ID = 1
RESERVED = 60 * UNITS_PER_S  # so far the reservation is ahead when it is made
_STAMP_MAX = (1 << 48) - 1
_HASH_BYTES = 6

Stream = bytes  # system id, component id, link id
State = tuple[int, int, dict[str, int]]


def stamp_of_unix(unix_us: int) -> int:
    """The time stamp of a Unix time in microseconds; 0 before 2015."""
    return max(0, unix_us // 10 - EPOCH_UNIX_S * UNITS_PER_S)


@dataclass(slots=True)
class Signing:
    """Signs what we send and checks what we receive, with one `key` of 32 bytes.

    `clock` gives monotonic seconds, and `offset` added to it our time in units of 10 us.
    `reserve` is called with a stamp that is about a minute ahead, before a stamp is used that was
    not reserved: who keeps it knows after a crash which stamps were never used.
    """

    key: bytes = field(repr=False)
    offset: int = 0
    clock: Callable[[], float] = lambda: 0.0
    reserve: Callable[[int], object] = lambda stamp: None
    reserved: float = math.inf
    newest: int = 0  # stamp of ours, or accepted of others
    streams: dict[Stream, int] = field(default_factory=dict)  # newest stamps that were accepted
    _keyed: Any = field(init=False, repr=False)  # SHA-256 of the key, to be continued

    def __post_init__(self) -> None:
        self._keyed = sha256(self.key)

    # --- out ---

    def sign(self, frame: bytes) -> bytes:
        """The frame, whose flags say that it is signed, with its signature."""
        self.newest = stamp = min(max(self.newest + 1, self._clock_stamp()), _STAMP_MAX)
        if stamp > self.reserved - RESERVED // 2:
            self.reserved = stamp + RESERVED
            self.reserve(stamp + RESERVED)
        stamped = frame + bytes((LINK_ID,)) + stamp.to_bytes(6, "little")
        hashed = self._keyed.copy()
        hashed.update(stamped)
        digest: bytes = hashed.digest()
        return stamped + digest[:_HASH_BYTES]

    def now(self) -> int:
        """Our own time."""
        return max(self.newest, self._clock_stamp())

    def _clock_stamp(self) -> int:
        return self.offset + int(UNITS_PER_S * self.clock())

    # --- in ---

    def fault(self, frame: Frame) -> DropReason | None:
        """Why this frame must not be used. Changes nothing."""
        return self.accept(frame, note=False)

    def accept(self, frame: Frame, *, note: bool = True) -> DropReason | None:
        """As `fault`; notes the time stamp of a frame without one. Called for each frame that
        arrives, therefore in one piece: it takes half as long."""
        raw = frame.raw
        if not frame.signed:
            return None if frame.message_id in ALLOWED_UNSIGNED else DropReason.UNSIGNED
        hashed = self._keyed.copy()  # a third faster than to hash the key each time
        hashed.update(raw[:-6])
        if not compare_digest(hashed.digest()[:6], raw[-6:]):
            return DropReason.BAD_SIGNATURE
        stream, stamp = raw[5:7] + raw[-13:-12], int.from_bytes(raw[-12:-6], "little")
        before = self.streams.get(stream)
        if before is None:
            if stamp < self.now() - BEHIND_MAX:
                return DropReason.OLD_STAMP
        elif stamp <= before:
            return DropReason.REPLAYED
        if note:
            self.streams[stream] = stamp
            if stamp > self.newest:
                self.newest = stamp
        return None

    # --- for another process that continues ---

    def state(self) -> State:
        """What another process needs to continue, without the key: the offset of our clock, the
        newest stamp, and those of others by stream, in hexadecimal digits."""
        return self.offset, self.newest, {name.hex(): each for name, each in self.streams.items()}

    @classmethod
    def resumed(cls, key: bytes, clock: Callable[[], float], state: State) -> Signing:
        """Continues `state`, with stamps that are a second ahead: more may have been sent since."""
        offset, newest, streams = state
        known = {bytes.fromhex(name): stamp for name, stamp in streams.items()}
        ahead = UNITS_PER_S
        return cls(key, offset + ahead, clock, newest=newest + ahead, streams=known)
