"""The flight directory and its .tlog, which has every frame sent or received and our own records.
Also functions that write other files, completely or not at all.

An entry of a .tlog is the Unix time in microseconds as a big-endian uint64 whose low two bits are
zero, then the unchanged frame. A crash loses the last hundredths of a second.
"""

from __future__ import annotations

import itertools
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from errno import EACCES, EEXIST, ENOENT, ENOTDIR
from pathlib import Path
from typing import BinaryIO

from offboard.documents.errors import UserError
from offboard.link.background import BackgroundWriter

_STAMP = struct.Struct(">Q")
QUEUED_MAX = 100_000  # entries: minutes of a flight
CLOSE_S = 10.0  # longest time to write the queue when the flight ends
FILES = ("flight.tlog", "flight.yaml", "score.json")  # in a flight directory


class LogError(UserError):
    """The flight directory cannot be written."""


class FlightLog:
    """Writes DIR/flight.tlog, and the configuration to DIR/flight.yaml. Never overwrites a flight.

    As a context manager it opens both files on entering, or raises LogError. After `start` alone,
    the writing thread opens them with the first entries. With `real_time`, an entry that does not
    fit into the queue is dropped; otherwise `write` waits for the disk. `descriptor` is the file
    descriptor of the open log, or -1.
    """

    def __init__(self, directory: Path, configuration: str, *, real_time: bool = False) -> None:
        self.directory = directory
        self.path = directory / "flight.tlog"
        self.configuration = configuration
        self.descriptor = -1
        self._real_time = real_time
        self._closed = False

    def check(self) -> None:
        """Raise LogError if the directory cannot be used. Creates nothing."""
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
            self._open()
        except FileExistsError as error:
            raise self._taken(Path(error.filename).name) from None
        except OSError as error:
            raise self._unwritable(error) from None
        self.start()
        return self

    def start(self) -> None:
        """Start the writing thread."""
        self._writer = BackgroundWriter[bytes](self._append, QUEUED_MAX, waits=not self._real_time)

    def _open(self) -> None:
        self.directory.mkdir(parents=True, exist_ok=True)
        # O_APPEND, because another process may continue the log
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND
        descriptor = os.open(self.path, flags, 0o666)
        configuration = self.directory / "flight.yaml"
        try:
            with configuration.open("x", encoding="utf-8") as file:
                file.write(self.configuration)
        except OSError as error:  # the flight does not begin, and leaves no file
            os.close(descriptor)
            self.path.unlink()
            if not isinstance(error, FileExistsError):
                configuration.unlink(missing_ok=True)
            raise
        self.descriptor = descriptor

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

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Write the queue, for at most CLOSE_S, and close the log. See `problem` afterwards."""
        if self._closed:
            return
        self._closed = True
        self._writer.close(CLOSE_S)
        if self._writer.is_free() and self.descriptor >= 0:  # not while the thread still writes
            try:
                os.close(self.descriptor)
            except OSError as error:  # NFS and quotas report only now what could not be written
                self._writer.error = error

    @property
    def problem(self) -> str:
        """A sentence that says why entries were lost; empty if none were."""
        error, dropped = self._writer.error, self._writer.dropped
        if error is None and not dropped:
            return ""
        reason = (getattr(error, "strerror", None) or error) if error else "the disk is too slow"
        return f"the log {self.path} cannot be written ({reason})"

    @property
    def lost(self) -> int:
        """Number of entries that were not written."""
        return self._writer.dropped

    def begin(self, unix_us: int, frame: bytes) -> None:
        """Append a frame at once, before the flight. Raises LogError if the disk fails."""
        try:
            self._append([entry(unix_us, frame)])
        except OSError as error:
            raise self._unwritable(error) from None

    def write(self, unix_us: int, frame: bytes) -> None:
        """Queue one frame and its Unix time."""
        self._writer.put(entry(unix_us, frame))

    def _append(self, entries: list[bytes]) -> None:
        if self.descriptor < 0:
            self._open()
        append(self.descriptor, entries)
        if not os.fstat(self.descriptor).st_nlink:
            raise FileNotFoundError(ENOENT, "it was deleted")


def entry(unix_us: int, frame: bytes) -> bytes:
    """One entry of a .tlog."""
    return _STAMP.pack(unix_us & ~3) + frame


def append(descriptor: int, entries: list[bytes]) -> None:
    """Write entries completely. A nearly full disk may accept a part of an entry; a reader of the
    log would then misread the next one."""
    rest = b"".join(entries)
    while rest:
        rest = rest[os.write(descriptor, rest) :]


@contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """Write a file that must not exist. It appears, complete, at the end of the block; if the block
    or the disk fails, it does not appear. Raises UserError."""
    incomplete = path.with_name(f".{os.getpid()}.part")
    try:
        with incomplete.open("xb") as file:
            yield file
        try:
            os.link(incomplete, path)  # unlike a rename, this fails if the file exists
        except OSError:  # the file exists, or the file system has no hard links
            if os.path.lexists(path):
                raise FileExistsError(EEXIST, os.strerror(EEXIST)) from None
            incomplete.rename(path)
    except OSError as error:
        raise UserError(f"{path} cannot be written ({error.strerror or error})") from None
    finally:
        with suppress(OSError):
            incomplete.unlink()


def replace_file(path: Path, text: str) -> None:
    """Write a file, or replace it once the new one is complete. Raises OSError; an existing file is
    then unchanged."""
    incomplete = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with incomplete.open("wb") as file:
            file.write(text.encode())
            file.flush()
            os.fsync(file.fileno())
        incomplete.replace(path)
    except OSError:
        with suppress(OSError):
            incomplete.unlink()
        raise


def free_name(path: Path) -> Path:
    """`path`, or the first of NAME-2, NAME-3 ... that does not exist."""
    numbered = (path.with_stem(f"{path.stem}-{number}") for number in itertools.count(2))
    return next(each for each in itertools.chain([path], numbered) if not each.exists())
