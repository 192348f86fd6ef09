"""Framing: finds frames in received bytes. pymavlink decodes a frame only when its message is read;
half of an autopilot's telemetry is never read.

If the bytes after a start byte are no frame, the search continues one byte later, so that a damaged
length field cannot hide a good frame. Nothing here raises, whatever the input. MAVLink 1 frames
(0xFE) are accepted; they have no extension fields, which are then zero.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from fastcrc import crc16

# `all` also holds CURRENT_MODE, which PX4 sends and `ardupilotmega` lacks
from pymavlink.dialects.v20 import all as mavlink

mavlink.MAVLINK_IGNORE_CRC = 0  # MAV_IGNORE_CRC of the environment must not switch checksums off

V2, V1 = 0xFD, 0xFE  # first byte of a frame of MAVLink 2 and 1
# Ids of messages that are recognised before they are decoded
HEARTBEAT, COMMAND_ACK, TIMESYNC, STATUSTEXT, SETUP_SIGNING = 0, 77, 111, 253, 256
# SET_ATTITUDE_TARGET, SET_POSITION_TARGET_LOCAL_NED and _GLOBAL_INT
SETPOINTS = frozenset({82, 84, 86})
_CRC_BYTES = 2
_CRC_EXTRA = {i: bytes((each.crc_extra,)) for i, each in mavlink.mavlink_map.items()}
_crc = crc16.mcrf4xx
_HEADER_BYTES_V2, _HEADER_BYTES_V1, _SIGNATURE_BYTES = 10, 6, 13
_SIGNED = 0x01  # incompatibility flag
_pymavlink = mavlink.MAVLink(None)


@dataclass
class Frame:
    """A received frame. `verified`: whether the checksum was checked and is correct; it is False
    only if pymavlink does not know the message id."""

    raw: bytes
    message_id: int
    system_id: int
    component_id: int
    sequence: int
    verified: bool

    @property
    def payload(self) -> bytes:
        """The payload as it is on the wire: MAVLink 2 omits trailing zeros."""
        return payload_of(self.raw)

    @cached_property
    def message(self) -> Any:
        """The message, decoded by pymavlink. Decoding a verified frame cannot fail."""
        return _pymavlink.decode(bytearray(self.raw))

    @property
    def signed(self) -> bool:
        """Whether the frame ends with a signature, which may be that of any key."""
        return self.raw[0] == V2 and self.raw[2] & _SIGNED != 0


class FrameSplitter:
    """Finds frames. A datagram holds complete frames; the data of a `stream` (serial, TCP) may end
    within a frame, which is kept for the next call. `frames` also counts frames with an unknown id,
    which `unknown` has by system and component id, `bytes_skipped` the bytes outside frames."""

    def __init__(self, stream: bool) -> None:
        self.bytes_received = self.bytes_skipped = self.frames = 0
        self.unknown: Counter[tuple[int, int]] = Counter()
        self._stream = stream
        self._rest = b""
        # index in the next data at which the last frame ends; -1: other bytes follow that frame
        self._behind = 0

    def split(self, data: bytes) -> list[Frame]:
        """The verified frames in `data`."""
        self.bytes_received += len(data)
        data = self._rest + data
        frames: list[Frame] = []
        at, end, behind = self._next_marker(data, 0), len(data), self._behind
        while at < end:
            stop = at + frame_size(data, at)
            frame = parse(data, at, stop) if stop <= end else None
            unsure, adjoins = frame is not None and not frame.verified, at == behind
            if self._stream and (stop > end or (unsure and adjoins and stop == end)):
                break  # the bytes that decide have not arrived
            # a frame whose checksum cannot be checked must fill the gap between two other frames
            if unsure and not (adjoins and (stop == end or data[stop] in (V2, V1))):
                frame = None
            if frame is None:
                self.bytes_skipped += 1
                at = self._next_marker(data, at + 1)
                continue
            self.frames += 1
            if frame.verified:
                frames.append(frame)
            else:
                self.unknown[frame.system_id, frame.component_id] += 1
            behind = stop
            at = self._next_marker(data, behind)
        self._rest, self._behind = data[at:], 0 if at == behind or not self._stream else -1
        return frames

    def _next_marker(self, data: bytes, at: int) -> int:
        """Index of the next start byte at or after `at`, or the length of `data`. The bytes before
        it are counted as skipped."""
        if data[at : at + 1] in (b"\xfd", b""):
            return at  # the usual case
        candidates = [i for i in (data.find(V2, at), data.find(V1, at)) if i >= 0]
        found = min(candidates, default=len(data))
        self.bytes_skipped += found - at
        return found


def frame_size(data: bytes, at: int) -> int:
    """Length of the frame whose header is at `at`. If the header is incomplete, the length of the
    shortest frame, which also ends beyond the data."""
    if at + 3 > len(data):
        return _HEADER_BYTES_V1 + _CRC_BYTES
    if data[at] == V1:
        return _HEADER_BYTES_V1 + data[at + 1] + _CRC_BYTES
    signature_bytes = _SIGNATURE_BYTES if data[at + 2] & _SIGNED else 0
    return _HEADER_BYTES_V2 + data[at + 1] + _CRC_BYTES + signature_bytes


def parse(data: bytes, at: int, end: int) -> Frame | None:
    """The frame in data[at:end], where `end` comes from `frame_size`. None if its checksum is
    wrong, or if it has incompatibility flags of a later MAVLink version."""
    raw = data[at:end]
    message_id = message_id_of(raw)
    if raw[0] == V1:
        header = raw[3], raw[4], raw[2]
        crc_at = _HEADER_BYTES_V1 + raw[1]
    elif raw[2] & ~_SIGNED:
        return None
    else:
        header = raw[5], raw[6], raw[4]
        crc_at = _HEADER_BYTES_V2 + raw[1]
    extra = _CRC_EXTRA.get(message_id)
    if extra is not None and _crc(extra, _crc(raw[1:crc_at])) != raw[crc_at] | raw[crc_at + 1] << 8:
        return None
    return Frame(raw, message_id, *header, extra is not None)


def message_id_of(raw: bytes) -> int:
    """The message id of a frame, as in `Frame`."""
    return raw[5] if raw[0] == V1 else raw[7] | raw[8] << 8 | raw[9] << 16


def payload_of(raw: bytes) -> bytes:
    """The payload of a frame, as in `Frame`."""
    at = _HEADER_BYTES_V1 if raw[0] == V1 else _HEADER_BYTES_V2
    return raw[at : at + raw[1]]
