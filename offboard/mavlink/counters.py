"""Counters of received bytes and frames, and of what was dropped, by reason.

Each byte received is in a frame, skipped or pending, and a frame is dropped for one reason.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from enum import Enum


class DropReason(Enum):
    """Why received data did not become an event; the value is a text for the user."""

    # bytes that did not become a frame
    TRUNCATED = "a frame cut short by the end of its datagram"
    BAD_CRC = "wrong checksum, or no frame"
    INCOMPATIBLE = "incompatibility flags of a later MAVLink version"
    FOREIGN_PEER = "a datagram from another address than the vehicle's"
    # frames
    UNKNOWN_ID = "a message id whose CRC_EXTRA is unknown"
    UNSIGNED = "no signature"
    BAD_SIGNATURE = "a signature of another key"
    REPLAYED = "a signature whose time stamp is not newer than the last one of its sender"
    OLD_STAMP = "a signature whose time stamp is more than a minute behind"
    NO_KEY = "the heartbeat of an autopilot that signs, without our key"
    ECHO = "a frame of our own, received back"
    SAME_IDS = "a frame with our own ids that another program sent"
    NO_VEHICLE = "before the first heartbeat of an autopilot"
    UNSUPPORTED_AUTOPILOT = "a heartbeat of an autopilot without dialect"
    FOREIGN_SYSTEM = "another system id than the vehicle's"
    FOREIGN_COMPONENT = "another component of the vehicle than its autopilot"
    NOT_FOR_US = "a command or acknowledgement for another system"
    IMPLAUSIBLE = "a value that is not finite or out of range"
    STALE = "older than the newest message of the same id"


FORGED = (
    DropReason.UNSIGNED,
    DropReason.BAD_SIGNATURE,
    DropReason.REPLAYED,
    DropReason.OLD_STAMP,
)


@dataclass(slots=True)
class Counters:
    """Totals since the session began."""

    bytes_received: int = 0
    bytes_framed: int = 0
    bytes_skipped: int = 0
    bytes_pending: int = 0
    frames: int = 0
    dropped: Counter[DropReason] = field(default_factory=Counter)
    _reported_next: int = 1  # number of them in the next of `news`

    def count(self, why: DropReason | None) -> None:
        """A frame was received; `why` it was dropped."""
        self.frames += 1
        if why is not None:
            self.dropped[why] += 1

    @property
    def forged(self) -> int:
        """Frames that signing refused."""
        return sum(self.dropped[each] for each in FORGED)

    def news(self) -> str:
        """What signing refused, on the 1st, 10th, 100th ... frame; else empty."""
        if self.forged < self._reported_next:
            return ""
        self._reported_next = 10 ** len(str(self.forged))
        named = (f"{self.dropped[each]:,} x {each.value}" for each in FORGED if self.dropped[each])
        return f"frames refused by signing: {', '.join(named)}"
