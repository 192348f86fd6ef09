"""Reads a .tlog: frames with their times, one after the other, in bounded memory.

An entry is a big-endian uint64 of Unix microseconds, then one unchanged MAVLink frame. A log that
ends inside an entry (after a crash) is read up to it. Damaged entries are skipped and counted: the
next one is where a time stamp is followed by a frame with a correct checksum. A file without any
entry is refused.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import all as dialect

from offboard.documents.errors import UserError, abridged
from offboard.mavlink.framing import V1, V2, Frame, frame_size, parse

_STAMP = struct.Struct(">Q")
_YEAR_2100_US = 4_102_444_800_000_000  # a computer without a clock begins in 1970
_MARKER = re.compile(rb"[\xfd\xfe]")  # the first byte of a frame
_LONGEST = 8 + 280  # bytes of an entry: a signed MAVLink 2 frame
_BLOCK = 1 << 20
_TUNNEL_BYTES = 133  # payload_type, target system and component, payload_length, 128 of data


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
        """The message decoded by pymavlink."""
        return self.frame.message

    @property
    def tunnelled(self) -> bytes:
        """The data of a TUNNEL message, without the zeros that fill it up."""
        payload = self.frame.payload.ljust(_TUNNEL_BYTES, b"\0")
        return payload[5 : 5 + payload[4]]


class Tlog:
    """A log to iterate over, as often as needed: its messages in order.

    After each iteration `damaged` is the number of places where entries were skipped,
    `first_damage` the first of them in bytes, `truncated` the bytes after the last entry.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damaged = self.first_damage = self.truncated = 0

    @property
    def damage(self) -> str:
        """One sentence on what could not be read; empty if all could."""
        if not self.damaged:
            return ""
        entries = f"{self.damaged} damaged entr{'ies were' if self.damaged > 1 else 'y was'}"
        return f"{self.path}: {entries} skipped, the first at byte {self.first_damage}"

    def __iter__(self) -> Iterator[LoggedMessage]:
        self.damaged = self.first_damage = self.truncated = 0
        try:
            with self.path.open("rb") as file:
                yield from self._messages(file)
        except OSError as error:
            raise UserError(f"{self.path} cannot be read: {error.strerror}") from None

    def _messages(self, file: BinaryIO) -> Iterator[LoggedMessage]:
        data, at, before = b"", 0, 0  # `before`: bytes of the file before `data`
        lost: int | None = None  # where the search for the next entry began
        found = cut = False  # `cut`: the file ends within the entry there, if its length is right
        while True:
            if at + _LONGEST + 9 > len(data) and (block := file.read(_BLOCK)):
                before, data, at = before + at, data[at:] + block, 0
                continue  # an entry, and the head of the next one
            if len(data) - at < 8 + 3:  # no entry can begin here
                break
            entry = _entry(data, at, certain=lost is not None)
            if entry is None:
                if lost is None:
                    cut = _begins(data, at) and _end(data, at) > len(data)
                    lost = before + at
                marker = _MARKER.search(data, at + 9)
                at = marker.start() - 8 if marker else len(data) - 8
                continue
            if lost is not None:
                self._count(lost)
            at += 8 + len(entry.frame.raw)
            found, lost = True, None
            yield entry
        if lost is not None and not cut:
            self._count(lost)
        else:
            self.truncated = before + len(data) - (before + at if lost is None else lost)
        if not found:
            raise UserError(
                f"{self.path} is not a .tlog, or empty: it holds no time stamp and MAVLink frame"
            )

    def _count(self, place: int) -> None:
        self.damaged += 1
        self.first_damage = self.first_damage if self.damaged > 1 else place


def _entry(data: bytes, at: int, *, certain: bool) -> LoggedMessage | None:
    """The entry that begins at `at`, None without. `certain`: its checksum must be known; else a
    message that pymavlink does not know is taken if an entry follows."""
    end = _end(data, at)
    if not _begins(data, at) or end > len(data):
        return None
    frame = parse(data, at + 8, end)
    if frame is None or not (frame.verified or (_begins(data, end) and not certain)):
        return None
    return LoggedMessage(_STAMP.unpack_from(data, at)[0], frame)


def _end(data: bytes, at: int) -> int:
    """Where the entry that begins at `at` ends; beyond the end of `data` if the entry is
    incomplete."""
    return at + 8 + frame_size(data, at + 8)


def _begins(data: bytes, at: int) -> bool:
    """Whether a time stamp and the first byte of a frame are at `at`, as far as the data go."""
    if at + 9 > len(data):
        return True
    (stamp,) = _STAMP.unpack_from(data, at)
    return data[at + 8] in (V1, V2) and stamp < _YEAR_2100_US


def find(flight: Path) -> Path:
    """The .tlog of a flight, given as flight directory or as file. Raises UserError."""
    path = flight / "flight.tlog" if flight.is_dir() else flight
    if not path.is_file():
        problem = "is not a regular file" if path.exists() else "does not exist"
        raise UserError(f"{abridged(path)} {problem}; name a flight directory or a .tlog file")
    return path


def read(flight: Path) -> Tlog:
    """The log of a flight to iterate over, given as for `find`. Raises UserError, also where the
    file is no .tlog or cannot be read."""
    log = Tlog(find(flight))
    next(iter(log))
    return log


@cache
def name_of(message_id: int) -> str:
    """The name of a message id in pymavlink, UNKNOWN_<id> without one."""
    kind = dialect.mavlink_map.get(message_id)
    return kind.msgname if kind else f"UNKNOWN_{message_id}"


@cache
def layout(name: str) -> np.dtype[np.void]:
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
