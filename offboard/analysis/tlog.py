"""Reads a .tlog: frames with their times, one after the other, in bounded memory.

An entry is a big-endian uint64 of Unix microseconds, then one unchanged MAVLink frame. If the log
ends inside an entry (after a crash), the entries before are read. Damaged entries are skipped and
counted: reading continues where a time stamp is followed by a frame with a correct checksum and by
another entry. A file without any entry is refused. Of several logs in one file only the first is
read: each log of a flight begins with its configuration.
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
from offboard.flight.record import CONFIGURATION_TYPE
from offboard.mavlink.framing import V1, V2, Frame, frame_size, parse
from offboard.mavlink.session import COMPONENT_ID, RECORD_COMPONENT_ID

OUR_COMPONENTS = (COMPONENT_ID, RECORD_COMPONENT_ID)
_STAMP = struct.Struct(">Q")
# Greatest plausible stamp. No least one: a computer without a battery-backed clock starts in 1970
_YEAR_2100_US = 4_102_444_800_000_000
_MARKER = re.compile(rb"[\xfd\xfe]")  # the first byte of a frame
_LONGEST = 8 + 280  # bytes of the longest entry, with a signed MAVLink 2 frame
_BLOCK = 1 << 20
_TUNNEL = 385  # message id
_TUNNEL_BYTES = 133  # payload_type, target system and component, payload_length, 128 of data


class LoggedMessage(NamedTuple):
    """One frame and the Unix time at which it was sent or received."""

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
    def record_type(self) -> int | None:
        """TUNNEL.payload_type of one of our records, None for any other message."""
        if self.frame.message_id != _TUNNEL or self.component_id not in OUR_COMPONENTS:
            return None
        return int.from_bytes(self.frame.payload[:2], "little")

    @property
    def begins_flight(self) -> bool:
        """Whether this is the first piece of the configuration of a flight."""
        return self.record_type == CONFIGURATION_TYPE and self.tunnelled[:2] == b"\0\0"

    @property
    def tunnelled(self) -> bytes:
        """The data of a TUNNEL message, without padding."""
        payload = self.frame.payload.ljust(_TUNNEL_BYTES, b"\0")
        return payload[5 : 5 + payload[4]]


class Tlog:
    """The messages of a log in order. It can be iterated over repeatedly.

    After an iteration `damaged` is the number of places where entries were skipped, `first_damage`
    the offset of the first place in bytes, and `truncated` the number of bytes after the last
    entry. `second_flight` is the offset of another flight, 0 if there is none.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damaged = self.first_damage = self.truncated = self.second_flight = 0

    @property
    def unread(self) -> str:
        """One sentence that says what was not read; empty if everything was."""
        said = []
        if self.second_flight:
            said.append(
                f"only the first flight is read, another begins at byte {self.second_flight}"
            )
        if self.damaged:
            entries = f"{self.damaged} damaged entr{'ies were' if self.damaged > 1 else 'y was'}"
            said.append(f"{entries} skipped, the first at byte {self.first_damage}")
        return f"{self.path}: {'; '.join(said)}" if said else ""

    def __iter__(self) -> Iterator[LoggedMessage]:
        self.damaged = self.first_damage = self.truncated = self.second_flight = 0
        try:
            with self.path.open("rb") as file:
                yield from self._messages(file)
        except OSError as error:
            raise UserError(f"{self.path} cannot be read: {error.strerror}") from None

    def _messages(self, file: BinaryIO) -> Iterator[LoggedMessage]:
        data, at, before = b"", 0, 0  # `before`: offset of `data` in the file
        lost: int | None = None  # offset at which the search for the next entry began, None: none
        found = has_flight = False
        cut = False  # whether the length of the entry at `lost` exceeds the file
        while True:
            if at + _LONGEST + 9 > len(data) and (block := file.read(_BLOCK)):
                before, data, at = before + at, data[at:] + block, 0
                continue  # `data` holds one whole entry and the head of the next one
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
            if entry.begins_flight:
                if has_flight:
                    self.second_flight = before + at
                    return
                has_flight = True
            at += 8 + len(entry.frame.raw)
            found, lost = True, None
            yield entry
        if lost is not None and not cut:
            self._count(lost)
        else:
            self.truncated = before + len(data) - (before + at if lost is None else lost)
        if not found:
            raise UserError(
                f"{self.path} is empty or not a .tlog: it has no time stamp with a MAVLink frame"
            )

    def _count(self, place: int) -> None:
        self.damaged += 1
        self.first_damage = self.first_damage if self.damaged > 1 else place


def _entry(data: bytes, at: int, *, certain: bool) -> LoggedMessage | None:
    """Return the entry at `at`, None if there is none.

    A correct checksum or another entry after it is enough, so that a message that pymavlink does
    not know is accepted. `certain`: both are needed, so that no frame of a file without time stamps
    (MAVProxy's .tlog.raw) is taken for an entry.
    """
    end = _end(data, at)
    if not _begins(data, at) or end > len(data):
        return None
    frame = parse(data, at + 8, end)
    if frame is None:
        return None
    followed = _begins(data, end)
    if not (frame.verified and followed if certain else frame.verified or followed):
        return None
    return LoggedMessage(_STAMP.unpack_from(data, at)[0], frame)


def _end(data: bytes, at: int) -> int:
    """Return where the entry at `at` ends; beyond the end of `data` if it is incomplete."""
    return at + 8 + frame_size(data, at + 8)


def _begins(data: bytes, at: int) -> bool:
    """Whether an entry may begin at `at`: a time stamp and the first byte of a frame. True if
    `data` ends before that byte."""
    if at + 9 > len(data):
        return True
    (stamp,) = _STAMP.unpack_from(data, at)
    return data[at + 8] in (V1, V2) and stamp < _YEAR_2100_US


def find(flight: Path) -> Path:
    """Return the .tlog of a flight. `flight` is its directory or the file. Raises UserError."""
    path = flight / "flight.tlog" if flight.is_dir() else flight
    if not path.is_file():
        problem = "is not a regular file" if path.exists() else "does not exist"
        raise UserError(f"{abridged(path)} {problem}; name a flight directory or a .tlog file")
    return path


def read(flight: Path) -> Tlog:
    """Open the log of a flight. `flight` is as for `find`. Raises UserError, also if the file is no
    .tlog or cannot be read."""
    log = Tlog(find(flight))
    next(iter(log))
    return log


@cache
def name_of(message_id: int) -> str:
    """Return the name of a message id in pymavlink, or UNKNOWN_<id>."""
    kind = dialect.mavlink_map.get(message_id)
    return kind.msgname if kind else f"UNKNOWN_{message_id}"


@cache
def layout(name: str) -> np.dtype[np.void]:
    """Return the layout of a message's payload on the wire, from pymavlink's definition."""
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
