"""Framing: frames are found in received bytes and packed for sending. Knows no message fields.

A frame of a known message needs a correct checksum. After bytes that are no frame the search
continues one byte later, so that a damaged length cannot hide a good frame. Nothing here raises,
whatever the input.

MAVLink 2 serialisation: 0xFD, length, incompatibility flags, compatibility flags, sequence, system,
component, 24-bit id, payload without its trailing zeros, CRC-16/MCRF4XX seeded with the message's
CRC_EXTRA, and 13 bytes of signature when incompatibility flag 1 is set. MAVLink 1 frames (0xFE)
are accepted: their payloads lack the extension fields, which are zero.
"""

from __future__ import annotations

import struct
from types import MappingProxyType
from typing import NamedTuple

from fastcrc import crc16
from pymavlink.dialects.v20 import ardupilotmega

from offboard.mavlink.counters import Counters, DropReason

_V2, _V1 = 0xFD, 0xFE
# Ids of messages that are needed before they are decoded
HEARTBEAT, COMMAND_ACK, TIMESYNC, STATUSTEXT, SETUP_SIGNING = 0, 77, 111, 253, 256
# SET_ATTITUDE_TARGET, SET_POSITION_TARGET_LOCAL_NED and _GLOBAL_INT: offset of target_system
SETPOINTS = MappingProxyType({82: 36, 84: 50, 86: 50})
_HEADER_V2 = struct.Struct("<BBBBBBBHB")
_HEADER_BYTES_V2, _HEADER_BYTES_V1, _CRC_BYTES, _SIGNATURE_BYTES = 10, 6, 2, 13
_SIGNED = 0x01
_crc = crc16.mcrf4xx

# ardupilotmega holds all of common; the last five are sent by PX4 1.16 and missing in pymavlink
# 2.4.50: LINK_NODE_STATUS, TIME_ESTIMATE_TO_TARGET, EVENT, CURRENT_EVENT_SEQUENCE, CURRENT_MODE.
_CRC_EXTRA: dict[int, bytes] = {
    message_id: bytes([extra])
    for message_id, extra in (
        {i: c.crc_extra for i, c in ardupilotmega.mavlink_map.items()}
        | {8: 117, 380: 232, 410: 160, 411: 106, 436: 193}
    ).items()
}


class Frame(NamedTuple):
    """`verified`: the checksum is correct. False only if the CRC_EXTRA of the id is unknown."""

    raw: bytes
    message_id: int
    system_id: int
    component_id: int
    sequence: int
    payload: bytes
    verified: bool

    @property
    def signed(self) -> bool:
        """It ends with a signature, whose key is not known here."""
        raw = self.raw
        return raw[0] == _V2 and raw[2] & _SIGNED != 0


class FrameSplitter:
    """Finds frames. A datagram holds whole frames. A stream (serial, TCP) may end within a frame,
    which is kept for the next call."""

    def __init__(self, stream: bool, counters: Counters) -> None:
        self._stream = stream
        self._counters = counters
        self._rest = b""
        self._aligned = True  # nothing was skipped since the last frame

    def split(self, data: bytes) -> list[Frame]:
        counters = self._counters
        counters.bytes_received += len(data)
        if self._rest:
            data = self._rest + data
        frames: list[Frame] = []
        at, end = 0, len(data)
        while at < end:
            start = _next_magic(data, at)
            self._skip(start - at)
            at = start
            if at == end:
                break
            outcome = self._parse_at(data, at)
            if outcome is None:
                break
            if isinstance(outcome, DropReason):
                counters.dropped[outcome] += 1
                self._skip(1)
                at += 1
            else:
                counters.bytes_framed += len(outcome.raw)
                self._aligned = True
                frames.append(outcome)
                at += len(outcome.raw)
        self._rest = data[at:]
        counters.bytes_pending = end - at
        return frames

    def _skip(self, count: int) -> None:
        if count:
            self._counters.bytes_skipped += count
            self._aligned = False

    def _parse_at(self, data: bytes, at: int) -> Frame | DropReason | None:
        """The frame at `at`, why there is none, or None if more bytes are needed."""
        size = frame_size(data, at)
        if size is None or at + size > len(data):
            return None if self._stream else DropReason.TRUNCATED
        frame = parse(data, at, at + size)
        if isinstance(frame, DropReason) or frame.verified:
            return frame
        # without a known checksum a frame must fill the space between two others
        if not self._aligned:
            return DropReason.BAD_CRC
        if at + size == len(data):
            return None if self._stream else frame
        return frame if data[at + size] in (_V2, _V1) else DropReason.BAD_CRC


def pack(
    message_id: int,
    payload: bytes,
    sequence: int,
    system_id: int,
    component_id: int,
    *,
    signed: bool = False,
) -> bytes:
    """A MAVLink 2 frame without signature; `signed`: its flags say that one follows. Trailing zeros
    of the payload are cut, except its first byte."""
    payload = payload[:1] + payload[1:].rstrip(b"\0")
    body = _HEADER_V2.pack(
        _V2,
        len(payload),
        _SIGNED if signed else 0,
        0,
        sequence,
        system_id,
        component_id,
        message_id & 0xFFFF,
        message_id >> 16,
    )
    body += payload
    crc = _crc(_CRC_EXTRA[message_id], _crc(body[1:]))
    return body + crc.to_bytes(2, "little")


def _next_magic(data: bytes, at: int) -> int:
    """Index of the next start byte of a frame, or the length of `data`."""
    if data[at] == _V2:
        return at
    candidates = [i for i in (data.find(_V2, at), data.find(_V1, at)) if i >= 0]
    return min(candidates, default=len(data))


def frame_size(data: bytes, at: int) -> int | None:
    """Frame length given by the header at `at`; None if the header is incomplete."""
    if at + 3 > len(data):
        return None
    if data[at] == _V1:
        return _HEADER_BYTES_V1 + data[at + 1] + _CRC_BYTES
    signature = _SIGNATURE_BYTES if data[at + 2] & _SIGNED else 0
    return _HEADER_BYTES_V2 + data[at + 1] + _CRC_BYTES + signature


def parse(data: bytes, at: int, end: int) -> Frame | DropReason:
    """The frame in data[at:end], which `frame_size` has measured, or why it is refused."""
    if data[at] == _V1:
        _, length, sequence, system, component, message_id = data[at : at + _HEADER_BYTES_V1]
        payload_at = at + _HEADER_BYTES_V1
    else:
        _, length, flags, _, sequence, system, component, low, high = _HEADER_V2.unpack_from(
            data, at
        )
        if flags & ~_SIGNED:
            return DropReason.INCOMPATIBLE
        message_id = low | high << 16
        payload_at = at + _HEADER_BYTES_V2
    crc_at = payload_at + length
    extra = _CRC_EXTRA.get(message_id)
    if extra is not None:
        crc = _crc(extra, _crc(data[at + 1 : crc_at]))
        if crc != data[crc_at] | data[crc_at + 1] << 8:
            return DropReason.BAD_CRC
    return Frame(
        data[at:end],
        message_id,
        system,
        component,
        sequence,
        data[payload_at:crc_at],
        extra is not None,
    )
