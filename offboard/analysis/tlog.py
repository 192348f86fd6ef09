"""A .tlog read back: stamped frames, decoded on demand. Knows MAVLink, judges nothing.

A record is a big-endian uint64 of Unix microseconds, then one unchanged MAVLink frame. A log cut
off in its last record (a crash) is read up to there; a file that is no .tlog is refused.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

_STAMP = struct.Struct(">Q")
_YEAR_2000_US, _YEAR_2100_US = 946_684_800_000_000, 4_102_444_800_000_000


class TlogError(Exception):
    """A file that cannot be read as a .tlog: one sentence for the user."""


@dataclass(frozen=True, slots=True)
class LoggedMessage:
    """One decoded frame and when it crossed the link."""

    unix_us: int
    system_id: int
    component_id: int
    name: str
    message: Any


@dataclass(frozen=True, slots=True)
class Tlog:
    """All decodable messages in order; `truncated` bytes at the end belong to no whole record."""

    messages: tuple[LoggedMessage, ...]
    truncated: int
    undecodable: int


def find(flight: Path) -> Path:
    """The .tlog of FLIGHT, which is a flight directory or the file itself."""
    path = flight / "flight.tlog" if flight.is_dir() else flight
    if not path.is_file():
        raise TlogError(f"{path} does not exist; name a flight directory or a .tlog file")
    return path


def read(path: Path) -> Tlog:
    """Read a whole log. Raises TlogError where the file is no .tlog or cannot be read."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise TlogError(f"{path} cannot be read: {error.strerror}") from None
    codec = dialect.MAVLink(None)
    messages: list[LoggedMessage] = []
    at = undecodable = 0
    for begin, end, stamp in _records(data, path):
        at = end
        try:
            message = codec.decode(bytearray(data[begin:end]))
        except dialect.MAVError:
            undecodable += 1
            continue
        messages.append(
            LoggedMessage(
                stamp,
                message.get_srcSystem(),
                message.get_srcComponent(),
                message.get_type(),
                message,
            )
        )
    return Tlog(tuple(messages), len(data) - at, undecodable)


def _records(data: bytes, path: Path) -> Iterator[tuple[int, int, int]]:
    """(begin, end, stamp) of each whole frame."""
    at = 0
    while at + 11 <= len(data):
        (stamp,) = _STAMP.unpack_from(data, at)
        magic = data[at + 8]
        if magic not in (0xFD, 0xFE) or not _YEAR_2000_US < stamp < _YEAR_2100_US:
            raise TlogError(f"{path} is not a .tlog: no time stamp and MAVLink frame at byte {at}")
        size = data[at + 9] + (8 if magic == 0xFE else 12)
        if magic == 0xFD and data[at + 10] & 1:
            size += 13
        end = at + 8 + size
        if end > len(data):
            return
        yield at + 8, end, stamp
        at = end
    if at == 0:
        raise TlogError(f"{path} is not a .tlog, or empty: it holds no whole MAVLink frame")
