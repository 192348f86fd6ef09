"""The flight directory and its .tlog: every frame sent or received, and our own records.

An entry of a .tlog is a big-endian uint64 of Unix microseconds, low two bits zero, and the frame
unchanged. Each entry is one unbuffered write: a crash loses at most the last one.
"""

from __future__ import annotations

import os
import struct
from errno import EACCES, ENOTDIR
from pathlib import Path
from types import TracebackType

from offboard.documents.errors import UserError

_STAMP = struct.Struct(">Q")
FILES = ("flight.tlog", "flight.yaml", "score.json")  # of a flight directory


class LogError(UserError):
    """The flight directory cannot be written: one sentence for the user."""


class FlightLog:
    """Context manager that writes DIR/flight.tlog, and the configuration to DIR/flight.yaml.

    Never overwrites a flight. Entering raises LogError.
    """

    def __init__(self, directory: Path, configuration: str) -> None:
        self.directory = directory
        self.path = directory / "flight.tlog"
        self.configuration = configuration

    def check(self) -> None:
        """Raise LogError if the directory cannot be used, without creating anything."""
        for name in FILES:
            if (self.directory / name).exists():
                raise self._taken(name)
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
        except FileExistsError as error:
            raise self._taken(Path(error.filename).name) from None
        except OSError as error:
            raise self._unwritable(error) from None
        return self

    def _write_configuration(self) -> None:
        try:
            text = self.configuration
            with (self.directory / "flight.yaml").open("x", encoding="utf-8") as file:
                file.write(text)
        except OSError:
            self._file.close()
            self.path.unlink()  # the empty log of a flight that does not begin
            raise

    def _taken(self, name: str) -> LogError:
        return LogError(
            f"{self.directory / name} exists: the directory already holds a flight; choose another "
            "directory with --out"
        )

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
        """Append a frame before the flight. Raises LogError on a full disk, which ends it."""
        try:
            self.write(unix_us, frame)
        except OSError as error:
            raise self._unwritable(error) from None

    def write(self, unix_us: int, frame: bytes) -> None:
        """Append one frame and its Unix time. Raises OSError on a full disk."""
        rest = _STAMP.pack(unix_us & ~3) + frame
        while rest:  # a nearly full disk accepts a part, which would hide the next entry
            rest = rest[self._file.write(rest) :]
