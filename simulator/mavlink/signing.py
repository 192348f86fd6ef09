"""MAVLink 2 signing as the simulated autopilot does it; implemented apart from the companion's.

All links of a vehicle share the key, the clock and the newest stamps of other senders, as in PX4
and ArduPilot. A signature has 13 bytes: link, 48 bits of time in units of 10 us since 2015-01-01
UTC, and the beginning of SHA-256 over key and signed frame.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field

EPOCH_UNIX_US = 1_420_070_400 * 1_000_000
US_PER_TICK = 10
A_MINUTE = 60 * 1_000_000 // US_PER_TICK
LATEST = 2**48 - 1
REFUSALS = UNSIGNED, WRONG, OLD = "unsigned", "wrong signature", "old time stamp"


@dataclass(slots=True)
class Keyring:
    """Key and clock of one vehicle; without a key nothing is signed and all is accepted.

    Args:
        accepted_unsigned: ids of messages that the firmware accepts without a signature.
        unix_us: Unix time of the vehicle's clock, in microseconds; None: stamps follow no clock.
    """

    accepted_unsigned: frozenset[int]
    unix_us: Callable[[], int] | None = None
    key: bytes = field(default=b"", repr=False)
    newest: int = 0  # stamp that was sent, or heard from somebody else
    stored: int = 0  # stamp that came with the key
    heard: dict[tuple[int, int, int], int] = field(default_factory=dict)  # system, component, link

    @property
    def on(self) -> bool:
        return bool(self.key)

    def set_up(self, key: bytes, stamp: int) -> None:
        """SETUP_SIGNING: a new key, or none if key and stamp are zero."""
        self.key = key if any(key) or stamp else b""
        self.stored = stamp
        self.restart()

    def restart(self) -> None:
        """Boot: the stamps are forgotten, but for the one that was stored with the key."""
        self.newest = self.stored
        self.heard.clear()

    def next_stamp(self) -> int:
        """Time stamp of the next frame."""
        self.newest = min(max(self.newest + 1, self._clock()), LATEST)
        return self.newest

    def complaint(self, message_id: int, sender: tuple[int, int], frame: bytes | None) -> str:
        """Why a received message is refused, empty if it is not. `frame` with its signature; None
        for an unsigned one."""
        if not self.on:
            return ""
        flaw = UNSIGNED if frame is None else self._flaw(sender, frame)
        return "" if message_id in self.accepted_unsigned else flaw

    def _flaw(self, sender: tuple[int, int], frame: bytes) -> str:
        """What is wrong with a signature; the time stamp of a right one is noted."""
        if self._digest(frame[:-6]) != frame[-6:]:
            return WRONG
        link, stamp = frame[-13], int.from_bytes(frame[-12:-6], "little")
        oldest = self.heard.get((*sender, link), self._now() - A_MINUTE - 1)
        if stamp <= oldest:
            return OLD
        self.heard[*sender, link] = stamp
        self.newest = max(self.newest, stamp)
        return ""

    def _clock(self) -> int:
        return max(0, self.unix_us() - EPOCH_UNIX_US) // US_PER_TICK if self.unix_us else 0

    def _now(self) -> int:
        return max(self.newest, self._clock())

    def _digest(self, frame: bytes) -> bytes:
        return hashlib.sha256(self.key + frame).digest()[:6]
