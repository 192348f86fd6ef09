"""Reads a .tlog: frames with their times, decoded on demand.

A record is a big-endian uint64 of Unix microseconds, then one unchanged MAVLink frame. A log that
ends inside a record (after a crash) is read up to it; a file that is no .tlog is refused.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as dialect

from offboard.documents.errors import UserError, abridged
from offboard.mavlink.counters import DropReason
from offboard.mavlink.framing import Frame, frame_size, parse

_STAMP = struct.Struct(">Q")
_YEAR_2000_US, _YEAR_2100_US = 946_684_800_000_000, 4_102_444_800_000_000
_MAGIC = (0xFD, 0xFE)
_codec = dialect.MAVLink(None)


class TlogError(UserError):
    """A file that cannot be read as a .tlog."""


class LoggedMessage(NamedTuple):
    """One frame and the time at which it was sent or received."""

    unix_us: int
    frame: Frame

    @property
    def system_id(self) -> int:
        return self.frame.system_id

    @property
    def component_id(self) -> int:
        return self.frame.component_id

    @property
    def name(self) -> str:
        """Name of the message in pymavlink, UNKNOWN_<id> without one."""
        return name_of(self.frame.message_id)

    @property
    def message(self) -> Any:
        """The message decoded by pymavlink, at each access."""
        return _codec.decode(bytearray(self.frame.raw))


@dataclass(frozen=True, slots=True)
class Tlog:
    """All decodable messages in order, and the bytes of an incomplete record at the end."""

    messages: tuple[LoggedMessage, ...]
    truncated: int
    undecodable: int


def find(flight: Path) -> Path:
    """The .tlog of a flight, given as flight directory or as file. Raises TlogError."""
    path = flight / "flight.tlog" if flight.is_dir() else flight
    if not path.is_file():
        problem = "is not a regular file" if path.exists() else "does not exist"
        raise TlogError(f"{abridged(path)} {problem}; name a flight directory or a .tlog file")
    return path


def read(path: Path) -> Tlog:
    """Read a whole log. Raises TlogError where the file is no .tlog or cannot be read."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise TlogError(f"{path} cannot be read: {error.strerror}") from None
    messages: list[LoggedMessage] = []
    end = undecodable = 0
    for begin, end, stamp in _records(data, path):
        frame = parse(data, begin, end)
        if isinstance(frame, DropReason):
            undecodable += 1
        else:
            messages.append(LoggedMessage(stamp, frame))
    return Tlog(tuple(messages), len(data) - end, undecodable)


def _records(data: bytes, path: Path) -> Iterator[tuple[int, int, int]]:
    """(begin, end, stamp) of each whole frame."""
    at = 0
    while at + 11 <= len(data):
        (stamp,) = _STAMP.unpack_from(data, at)
        if data[at + 8] not in _MAGIC or not _YEAR_2000_US < stamp < _YEAR_2100_US:
            raise TlogError(f"{path} is not a .tlog: no time stamp and MAVLink frame at byte {at}")
        size = frame_size(data, at + 8)
        if size is None or at + 8 + size > len(data):
            return
        yield at + 8, at + 8 + size, stamp
        at += 8 + size
    if at == 0:
        raise TlogError(f"{path} is not a .tlog, or empty: it holds no whole MAVLink frame")


@cache
def name_of(message_id: int) -> str:
    """The name of a message id in pymavlink, UNKNOWN_<id> without one."""
    kind = dialect.mavlink_map.get(message_id)
    return kind.msgname if kind else f"UNKNOWN_{message_id}"


def columns(name: str, messages: Sequence[LoggedMessage], fields: str) -> NDArray[np.float64]:
    """The fields of messages named `name` as rows (N, columns).

    `fields` are separated by spaces; an array field fills as many columns as it has elements. Gives
    the values of `message` for all messages at once.
    """
    layout = _layout(name)
    size = layout.itemsize
    payloads = b"".join(entry.frame.payload[:size].ljust(size, b"\0") for entry in messages)
    rows = np.frombuffer(payloads, layout)
    parts = []
    for field in fields.split():
        width = math.prod(layout[field].shape)
        parts.append(rows[field].reshape(len(rows), width).astype(np.float64))
    return np.hstack(parts)


@cache
def _layout(name: str) -> np.dtype[np.void]:
    """The layout of the payload on the wire, from pymavlink's definition of the message."""
    kind = getattr(dialect, f"MAVLink_{name.lower()}_message")
    formats = kind.native_format.decode().lstrip("<")
    return np.dtype(
        [
            (field, f"<{code}", (length,) if length else ())
            for field, code, length in zip(
                kind.ordered_fieldnames, formats, kind.array_lengths, strict=True
            )
        ]
    )
