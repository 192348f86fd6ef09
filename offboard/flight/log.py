"""The flight directory and its .tlog: every frame that crossed the link, and our own records.

A .tlog record is a big-endian uint64 of Unix microseconds, low two bits zero, then the frame
unchanged. Each record is one unbuffered write, so a crash loses at most the last one.
"""

from __future__ import annotations

import os
import struct
from errno import EACCES, ENOTDIR
from pathlib import Path
from types import TracebackType

from offboard.documents.errors import UserError

_STAMP = struct.Struct(">Q")


class LogError(UserError):
    """The flight directory cannot be written: one sentence for the user."""


class FlightLog:
    """Writes DIR/flight.tlog, and beside it flight.yaml with what the flight is flown with.

    Never overwrites: a directory that holds a flight is refused.
    """

    def __init__(self, directory: Path, configuration: str) -> None:
        self.directory = directory
        self.path = directory / "flight.tlog"
        self.configuration = configuration

    def check(self) -> None:
        """Raise LogError for what can be told without making anything."""
        if self.path.exists():
            raise self._taken()
        places = (self.directory, *self.directory.absolute().parents)
        place = next(path for path in places if path.exists())
        if not place.is_dir():
            raise self._unwritable(NotADirectoryError(ENOTDIR, os.strerror(ENOTDIR)))
        if not os.access(place, os.W_OK | os.X_OK):
            raise self._unwritable(PermissionError(EACCES, os.strerror(EACCES)))

    def __enter__(self) -> FlightLog:
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            self._file = self.path.open("xb", buffering=0)
            self._write_configuration()
        except FileExistsError:
            raise self._taken() from None
        except OSError as error:
            raise self._unwritable(error) from None
        return self

    def _write_configuration(self) -> None:
        try:
            text = self.configuration
            (self.directory / "flight.yaml").write_text(text, encoding="utf-8")
        except OSError:
            self._file.close()
            self.path.unlink()  # an empty log is no flight that must be kept
            raise

    def _taken(self) -> LogError:
        return LogError(f"{self.path} already holds a flight; choose another directory with --out")

    def _unwritable(self, error: OSError) -> LogError:
        return LogError(
            f"the flight cannot be recorded in {self.directory}: {error.strerror}; "
            "choose a directory that can be written with --out"
        )

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def begin(self, unix_us: int, frame: bytes) -> None:
        """Append a frame before anything was sent: a disk that is full then refuses the flight."""
        try:
            self.write(unix_us, frame)
        except OSError as error:
            raise self._unwritable(error) from None

    def write(self, unix_us: int, frame: bytes) -> None:
        """Append one frame with its time of crossing. A full disk raises OSError."""
        rest = _STAMP.pack(unix_us & ~3) + frame
        while rest:  # a disk that fills up takes a part; what came next would lie inside it
            rest = rest[self._file.write(rest) :]
