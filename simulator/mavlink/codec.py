"""MAVLink 2 frames to and from plain values, implemented for the simulator.

Only the message tables (ids, field order, CRC extra) come from the dialect; packing, checksums and
framing are independent of the companion's codec, so that an error in one of them shows between
them. Knows no vehicle, no socket and no clock. Nothing a peer sends makes it raise.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as dialect  # also CURRENT_MODE, which common lacks

from simulator.mavlink.signing import REFUSALS, SIGNATURE_LENGTH, Keyring

MAGIC_V1 = 0xFE
MAGIC_V2 = 0xFD
SIGNED = 0x01  # incompatibility flag: 13 bytes of signature follow

_HEADER_V2 = struct.Struct("<BBBBBBHB")  # length, flags x 2, seq, sys, comp, id (24 bit)
_MAGIC_BYTE = bytes((MAGIC_V2,))


@dataclass(frozen=True, slots=True)
class Message:
    """One decoded frame: `values` by field name, strings without padding, arrays as tuples."""

    name: str
    id: int
    system: int
    component: int
    values: dict[str, Any]

    def __getattr__(self, field_name: str) -> Any:
        try:
            return self.values[field_name]
        except KeyError:
            raise AttributeError(field_name) from None


class Layout:
    """Payload layout of one message. `pack` takes the values in the field order of the XML."""

    def __init__(self, message: Any) -> None:
        self.id: int = message.id
        self.name: str = message.msgname
        self.crc_extra: int = message.crc_extra
        self.fields = tuple(message.fieldnames)
        self.extra_byte = bytes((message.crc_extra,))
        self._struct: struct.Struct = message.unpacker
        is_text = [fmt.endswith("s") for fmt in _formats(message)]
        spans = [
            1 if text else length for text, length in zip(is_text, message.lengths, strict=True)
        ]
        self._pack = _packer(message, spans)
        self._named = _namer(message.ordered_fieldnames, spans, is_text)

    def pack(self, values: Sequence[Any]) -> bytes:
        """Payload with its trailing zeros removed (at least one byte stays).

        Raises TypeError, which names message and field, for too few or too many values.
        """
        payload = self._pack(*values)
        if payload[-1]:
            return payload
        return payload.rstrip(b"\0") or b"\0"

    def unpack(self, payload: bytes) -> dict[str, Any]:
        """Values by name; a short payload is filled with zeros, a long one cut (MAVLink 2)."""
        size = self._struct.size
        if len(payload) != size:
            payload = payload[:size].ljust(size, b"\0")
        return self._named(self._struct.unpack(payload))


def _packer(message: Any, spans: Sequence[int]) -> Callable[..., bytes]:
    """Function from values in the order of the XML, arrays as sequences, to the payload.

    Generated as one expression, as `namedtuple` does: a loop takes five times as long.
    """
    terms = [
        name if span == 1 else f"*{name}"
        for name, span in zip(message.ordered_fieldnames, spans, strict=True)
    ]
    packer: Callable[..., bytes] = eval(
        f"lambda {', '.join(message.fieldnames)}: pack_({', '.join(terms)})",
        {"pack_": message.unpacker.pack},
    )
    packer.__qualname__ = message.msgname
    return packer


def _namer(
    names: Sequence[str], spans: Sequence[int], is_text: Sequence[bool]
) -> Callable[[tuple[Any, ...]], dict[str, Any]]:
    """Function from unpacked values in payload order to values by name; generated likewise."""
    terms = []
    at = 0
    for name, span, text in zip(names, spans, is_text, strict=True):
        value = f"v[{at}]" if span == 1 else f"v[{at}:{at + span}]"
        terms.append(f"{name!r}: {f'text({value})' if text else value}")
        at += span
    namer: Callable[[tuple[Any, ...]], dict[str, Any]] = eval(
        f"lambda v: {{{', '.join(terms)}}}", {"text": _text}
    )
    return namer


def _text(value: bytes) -> str:
    return value.split(b"\0", 1)[0].decode("ascii", "replace")


def _formats(message: Any) -> list[str]:
    """One struct format per wire field, taken from the payload's format string."""
    formats: list[str] = []
    digits = ""
    for letter in message.unpacker.format.lstrip("<"):
        if letter.isdigit():
            digits += letter
        else:
            formats.append(digits + letter)
            digits = ""
    return formats


@cache
def layout(name: str) -> Layout:
    """Layout of the message called `name`; KeyError when the dialect has none."""
    return Layout(dialect.mavlink_map[getattr(dialect, f"MAVLINK_MSG_ID_{name}")])


@cache
def layout_by_id(message_id: int) -> Layout | None:
    """Layout of message `message_id`, or None when the dialect has none."""
    message = dialect.mavlink_map.get(message_id)
    return None if message is None else Layout(message)


def id_of(name: str) -> int | None:
    """Id of the message called `name`, or None when the dialect has none."""
    found = getattr(dialect, f"MAVLINK_MSG_ID_{name}", None)
    return found if found in dialect.mavlink_map else None


def name_of(message_id: int) -> str | None:
    """Name of message `message_id`, or None when the dialect has none."""
    found = layout_by_id(message_id)
    return None if found is None else found.name


def frame(
    sequence: int,
    system: int,
    component: int,
    message: Layout,
    payload: bytes,
    *,
    flags: int = 0,
) -> bytes:
    """One MAVLink 2 frame with a packed payload, without its signature if `flags` has SIGNED."""
    low, high = message.id & 0xFFFF, message.id >> 16
    head = _HEADER_V2.pack(len(payload), flags, 0, sequence, system, component, low, high)
    body = head + payload
    crc = mcrf4xx(body + message.extra_byte)
    return _MAGIC_BYTE + body + crc.to_bytes(2, "little")


@dataclass
class Decoder:
    """Datagrams -> messages. Unreadable bytes are dropped and counted by reason.

    A datagram holds whole frames: nothing is kept for the next one, so that garbage cannot delay
    or hide a later command. A message that `keyring` refuses is dropped.
    """

    keyring: Keyring | None = None
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
            head, message_id = 10, data[at + 7] | data[at + 8] << 8 | data[at + 9] << 16
            system, component, flags = data[at + 5], data[at + 6], data[at + 2]
        elif data[at] == MAGIC_V1 and left >= 8:
            head, message_id = 6, data[at + 5]
            system, component, flags = data[at + 3], data[at + 4], 0
        else:
            return self._skip("not a frame")
        stop = at + head + data[at + 1]
        length = stop + 2 - at + (SIGNATURE_LENGTH if flags & SIGNED else 0)
        known = layout_by_id(message_id)
        if flags & ~SIGNED:
            return self._skip("incompatible flags")
        if length > left:
            return self._skip("truncated")
        if known is None:
            # no CRC extra to verify with: taken as a frame if another, or nothing, follows
            self.dropped["unknown message"] += 1
            follows = length == left or data[at + length] in (MAGIC_V1, MAGIC_V2)
            return (length if follows else 1), None
        crc = mcrf4xx(data[at + 1 : stop] + bytes((known.crc_extra,)))
        if data[stop] | data[stop + 1] << 8 != crc:
            return self._skip("checksum")
        if self.keyring is not None:
            signed = data[at : at + length] if flags & SIGNED else None
            refused = self.keyring.complaint(message_id, (system, component), signed)
            if refused:
                self.dropped[refused] += 1
                return length, None
        values = known.unpack(data[at + head : stop])
        return length, Message(known.name, message_id, system, component, values)

    def _skip(self, reason: str) -> tuple[int, None]:
        self.dropped[reason] += 1
        return 1, None
