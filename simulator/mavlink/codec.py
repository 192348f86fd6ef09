"""MAVLink 2 frames to and from messages, by pymavlink; signing as the simulated autopilot does it.

A datagram is cut into frames here, so that garbage and truncated frames cannot delay or hide a
later command; pymavlink decodes, checks, packs and signs them. Received signatures are checked
here, apart from the companion's code. Knows no vehicle, no socket and no clock. Nothing a peer
sends makes it raise.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from pymavlink.dialects.v20 import all as dialect  # with CURRENT_MODE, which common lacks

from simulator.link.framing import MAGIC_V1, MAGIC_V2, SIGNED, frame_length

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

    accepted_unsigned: frozenset[int] = frozenset()
    unix_us: Callable[[], int] | None = None
    key: bytes = field(default=b"", repr=False)
    newest: int = 0  # stamp that was sent, or heard from somebody else
    stored: int = 0  # stamp that came with the key
    heard: dict[tuple[int, int, int], int] = field(default_factory=dict)  # system, component, link

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
        if not self.key:
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


_codec = dialect.MAVLink(None)
_BY_NAME: dict[str, Any] = {each.msgname: each for each in dialect.mavlink_map.values()}

Message = Any  # pymavlink's: fields are attributes, strings without padding
Peer = tuple[int, int]  # system, component


def sender_of(message: Message) -> Peer:
    """Who sent a received message."""
    return message.get_srcSystem(), message.get_srcComponent()


def target_of(message: Message) -> Peer:
    """Whom a message is for; 0 is all, also for a message without such a field."""
    return getattr(message, "target_system", 0), getattr(message, "target_component", 0)


def id_of(name: str) -> int | None:
    """Id of the message called `name`, or None when the dialect has none."""
    return _BY_NAME[name].id if name in _BY_NAME else None


def name_of(message_id: int) -> str | None:
    """Name of message `message_id`, or None when the dialect has none."""
    message = dialect.mavlink_map.get(message_id)
    return None if message is None else message.msgname


def fields_of(name: str) -> list[str]:
    """The fields of the message called `name`, in the order of the XML."""
    return list(_BY_NAME[name].fieldnames)


class Encoder:
    """Frames of one sender. With a key of `keyring` they are signed; `link` is the number of the
    link in the signature."""

    def __init__(
        self, system: int, component: int, keyring: Keyring | None = None, link: int = 0
    ) -> None:
        self._keyring = keyring or Keyring()
        self._mavlink = dialect.MAVLink(None, system, component)
        self._mavlink.signing.link_id = link

    def frame(self, name: str, values: Sequence[object]) -> bytes:
        """A message as one MAVLink 2 frame with the next sequence number; `values` in the field
        order of the XML, extensions may be left out.

        Raises KeyError when the dialect has no such message, TypeError for a wrong number of
        values.
        """
        mavlink, key = self._mavlink, self._keyring.key
        mavlink.signing.sign_outgoing = bool(key)
        if key:
            mavlink.signing.secret_key = key
            mavlink.signing.timestamp = self._keyring.next_stamp()
        packed: bytes = _BY_NAME[name](*values).pack(mavlink)
        mavlink.seq = (mavlink.seq + 1) & 0xFF
        return packed


@dataclass
class Decoder:
    """Datagrams -> messages. Unreadable bytes are dropped and counted by reason.

    A datagram holds whole frames: nothing is kept for the next one. A message that `keyring`
    refuses is dropped.
    """

    keyring: Keyring = field(default_factory=Keyring)
    dropped: Counter[str] = field(default_factory=Counter)

    @property
    def refused(self) -> Counter[str]:
        """Messages that `keyring` refused, by reason."""
        return Counter({f"message refused: {why}": self.dropped[why] for why in REFUSALS})

    def read(self, datagram: bytes) -> list[Message]:
        """All intact messages of `datagram`, in order, also those after garbage."""
        messages: list[Message] = []
        at = 0
        while at < len(datagram):
            length, message = self._at(datagram, at)
            if message is not None:
                messages.append(message)
            at += length
        return messages

    def _at(self, data: bytes, at: int) -> tuple[int, Message | None]:
        """Number of bytes to skip, and the message that begins at `at`, if one does."""
        left = len(data) - at
        if data[at] == MAGIC_V2 and left >= 12:
            flags, message_id = data[at + 2], int.from_bytes(data[at + 7 : at + 10], "little")
        elif data[at] == MAGIC_V1 and left >= 8:
            flags, message_id = 0, data[at + 5]
        else:
            return self._skip("not a frame")
        length = frame_length(data, at)
        if flags & ~SIGNED:
            return self._skip("incompatible flags")
        if length > left:
            return self._skip("truncated")
        if message_id not in dialect.mavlink_map:
            # no CRC extra to verify with: taken as a frame if another, or nothing, follows
            self.dropped["unknown message"] += 1
            follows = length == left or data[at + length] in (MAGIC_V1, MAGIC_V2)
            return (length if follows else 1), None
        frame = data[at : at + length]
        try:
            message = _codec.decode(bytearray(frame))
        except dialect.MAVError:
            return self._skip("checksum")
        signed = frame if flags & SIGNED else None
        refused = self.keyring.complaint(message_id, sender_of(message), signed)
        if refused:
            self.dropped[refused] += 1
            return length, None
        return length, message

    def _skip(self, reason: str) -> tuple[int, None]:
        self.dropped[reason] += 1
        return 1, None
