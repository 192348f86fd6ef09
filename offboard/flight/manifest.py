"""The manifest: the configuration of a flight inside its log, compressed and in numbered pieces,
and which vehicle it flew.

The pieces are TUNNEL messages of our record component, the first entries of the .tlog. `pieces`
splits a text, `join` restores it.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterable
from dataclasses import asdict

from offboard.mavlink.events import VehicleFound
from offboard.mavlink.outgoing import ConfigurationRecord

PAYLOAD_TYPE = 0xC0F1  # TUNNEL.payload_type; numbers above 32767 need no registration
VEHICLE_TYPE = 0xC0F3  # TUNNEL.payload_type of the vehicle
_HEAD = struct.Struct("<HH")  # index of the piece, number of pieces
_PIECE_BYTES = 128 - _HEAD.size
TEXT_MOST = 4_000_000  # bytes: eight of the longest configuration files; a log may be anybody's


def vehicle_record(vehicle: VehicleFound) -> ConfigurationRecord:
    """The record that says which vehicle is flown."""
    return ConfigurationRecord(json.dumps(asdict(vehicle)).encode(), VEHICLE_TYPE)


def vehicle_of(payload: bytes) -> VehicleFound | None:
    """The vehicle in the payload of such a record; None if it is damaged."""
    try:
        return VehicleFound(**json.loads(payload))
    except (ValueError, TypeError):
        return None


def pieces(text: str) -> list[ConfigurationRecord]:
    """Records that hold `text`, in order."""
    data = zlib.compress(text.encode("utf-8"), 9)
    parts = [data[at : at + _PIECE_BYTES] for at in range(0, len(data), _PIECE_BYTES)]
    return [
        ConfigurationRecord(_HEAD.pack(index, len(parts)) + part, PAYLOAD_TYPE)
        for index, part in enumerate(parts)
    ]


def join(payloads: Iterable[bytes]) -> str | None:
    """The text in the payloads of TUNNEL messages; None if a piece is missing or damaged. Raises
    ValueError for a text of more than TEXT_MOST bytes."""
    parts: dict[int, bytes] = {}
    count = 0
    for payload in payloads:
        if len(payload) > _HEAD.size:
            index, count = _HEAD.unpack_from(payload)
            parts[index] = payload[_HEAD.size :]
        if len(parts) == count > 0:  # they are the first entries of a log
            break
    if not count or sorted(parts) != list(range(count)):
        return None
    unpacked = zlib.decompressobj()
    try:
        data = unpacked.decompress(b"".join(parts[index] for index in range(count)), TEXT_MOST)
        if unpacked.eof:
            return data.decode("utf-8")
    except (zlib.error, UnicodeDecodeError):
        return None
    if len(data) == TEXT_MOST:
        raise ValueError(f"its configuration unpacks to more than {TEXT_MOST // 1000} kB")
    return None
