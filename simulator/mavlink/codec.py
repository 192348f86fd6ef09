"""MAVLink 2 frames to and from messages, with pymavlink; signing as the simulated autopilots do it.

This module divides a datagram into frames, so that garbage and truncated frames cannot delay or
hide a later command; pymavlink decodes, checks, packs and signs them. Received signatures are
checked here, independently of the companion's code. Knows no vehicle, no socket and no clock.
Nothing that a peer sends makes it raise.
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
    """Signing key and time stamps of one vehicle. Without a key nothing is signed, and every
    message is accepted.

    Args:
        accepted_unsigned: ids of messages that the firmware accepts without a signature.
        unix_us: Unix time of the vehicle's clock, in microseconds; None: time stamps only count.
    """

    accepted_unsigned: frozenset[int] = frozenset()
    unix_us: Callable[[], int] | None = None
    key: bytes = field(default=b"", repr=False)
    newest: int = 0  # greatest time stamp that was sent or received
    stored: int = 0  # time stamp that was set with the key
    # newest time stamp by system, component and link
    heard: dict[tuple[int, int, int], int] = field(default_factory=dict)

    def set_up(self, key: bytes, stamp: int) -> None:
        """Apply SETUP_SIGNING: a new key, or no signing if key and time stamp are zero."""
        self.key = key if any(key) or stamp else b""
        self.stored = stamp
        self.restart()

    def restart(self) -> None:
        """Forget the time stamps, as at boot, except the one that was set with the key."""
        self.newest = self.stored
        self.heard.clear()

    def next_stamp(self) -> int:
        """Return the time stamp of the next frame, in 10 us since 2015."""
        self.newest = min(max(self.newest + 1, self._clock()), LATEST)
        return self.newest

    def refusal(self, message_id: int, sender: tuple[int, int], frame: bytes | None) -> str:
        """Return why a received message is refused; empty if it is accepted. `frame` is the frame
        with its signature; None: it is unsigned."""
        if not self.key:
            return ""
        flaw = UNSIGNED if frame is None else self._flaw(sender, frame)
        return "" if message_id in self.accepted_unsigned else flaw

    def _flaw(self, sender: tuple[int, int], frame: bytes) -> str:
        """Return what is wrong with a signature, or store the time stamp of a valid one."""
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

Message = Any  # a pymavlink message: its fields are attributes, its strings have no padding
Peer = tuple[int, int]  # system, component


def sender_of(message: Message) -> Peer:
    """Return the sender of a received message."""
    return message.get_srcSystem(), message.get_srcComponent()


def target_of(message: Message) -> Peer:
    """Return the target of a message; 0 means all, also if the message has no such field."""
    return getattr(message, "target_system", 0), getattr(message, "target_component", 0)


def id_of(name: str) -> int | None:
    """Return the id of the message `name`, or None if the dialect does not have it."""
    return _BY_NAME[name].id if name in _BY_NAME else None


def name_of(message_id: int) -> str | None:
    """Return the name of message `message_id`, or None if the dialect does not have it."""
    message = dialect.mavlink_map.get(message_id)
    return None if message is None else message.msgname


def fields_of(name: str) -> list[str]:
    """Return the names of the fields of message `name`, in the order of the XML."""
    return list(_BY_NAME[name].fieldnames)


class Encoder:
    """Makes the frames of one sender, signed if `keyring` has a key. `link` is the link id in the
    signature."""

    def __init__(
        self, system: int, component: int, keyring: Keyring | None = None, link: int = 0
    ) -> None:
        self._keyring = keyring or Keyring()
        self._mavlink = dialect.MAVLink(None, system, component)
        self._mavlink.signing.link_id = link

    def frame(self, name: str, values: Sequence[object]) -> bytes:
        """Return a message as a MAVLink 2 frame with the next sequence number.

        `values` are in the field order of the XML; extensions may be left out. Raises KeyError if
        the dialect has no such message, TypeError for a wrong number of values.
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
    """Decodes the messages of datagrams. Invalid bytes are dropped and counted by reason.

    A datagram has whole frames, so nothing is kept for the next one. Messages that `keyring`
    refuses are dropped, too.
    """

    keyring: Keyring = field(default_factory=Keyring)
    dropped: Counter[str] = field(default_factory=Counter)

    @property
    def refused(self) -> Counter[str]:
        """Number of messages that `keyring` refused, by reason."""
        return Counter({f"message refused: {why}": self.dropped[why] for why in REFUSALS})

    def read(self, datagram: bytes) -> list[Message]:
        """Return all intact messages of `datagram`, in order, also those after garbage."""
        messages: list[Message] = []
        at = 0
        while at < len(datagram):
            length, message = self._at(datagram, at)
            if message is not None:
                messages.append(message)
            at += length
        return messages

    def _at(self, data: bytes, at: int) -> tuple[int, Message | None]:
        """Return the number of bytes to skip, and the message that begins at `at`, or None."""
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
            # Without CRC_EXTRA its checksum cannot be verified: it counts as a frame if the
            # datagram ends or another frame begins after it
            self.dropped["unknown message"] += 1
            follows = length == left or data[at + length] in (MAGIC_V1, MAGIC_V2)
            return (length if follows else 1), None
        frame = data[at : at + length]
        try:
            message = _codec.decode(bytearray(frame))
        except dialect.MAVError:
            return self._skip("checksum")
        signed = frame if flags & SIGNED else None
        refused = self.keyring.refusal(message_id, sender_of(message), signed)
        if refused:
            self.dropped[refused] += 1
            return length, None
        return length, message

    def _skip(self, reason: str) -> tuple[int, None]:
        self.dropped[reason] += 1
        return 1, None
