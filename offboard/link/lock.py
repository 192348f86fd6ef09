"""One service for each connection and directory: locks that its process holds, whatever becomes of
it.
"""

from __future__ import annotations

import fcntl
import os
import re
import socket
import struct
import sys
import tempfile
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType

from offboard.documents.errors import UserError

_LINUX = sys.platform == "linux"
_NAME_MAX = 90  # of 107 characters of an abstract address
_REFUSED_MAX = 4096  # services that are told who holds a lock


class LockError(UserError):
    """A lock file that cannot be opened: one sentence for the user."""


class Locked(LockError):
    """Another service has it: one sentence that says which process."""

    is_usage = False

    def __init__(self, what: str, holder: int | str) -> None:
        super().__init__(f"another service has the {what}: process {holder or 'unknown'}")


class Lock:
    """Context manager; entering raises LockError. The file stays, with the number of the last
    process: the kernel releases the lock with the process. `what` the lock is for, for the
    sentence."""

    def __init__(self, path: Path, what: str) -> None:
        self._path = path
        self._what = what

    def __enter__(self) -> None:
        try:
            self._descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise LockError(f"the lock {self._path} cannot be opened: {error.strerror}") from None
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            holder = os.read(self._descriptor, 20).decode(errors="replace").strip()
            os.close(self._descriptor)
            raise Locked(self._what, holder) from None
        os.ftruncate(self._descriptor, 0)
        os.write(self._descriptor, f"{os.getpid()}\n".encode())

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        os.close(self._descriptor)


class NameLock:
    """Context manager; entering raises Locked. As `Lock`, but by an abstract Unix address (Linux),
    which all users and units see, and which belongs to a network namespace as ports do."""

    def __init__(self, name: str, what: str) -> None:
        self._address = f"\0{name}"
        self._what = what

    def __enter__(self) -> None:
        with ExitStack() as stack:
            self._socket = stack.enter_context(socket.socket(socket.AF_UNIX))
            try:
                self._socket.bind(self._address)
                self._socket.listen(_REFUSED_MAX)
            except OSError:
                raise Locked(self._what, self._holder()) from None
            stack.pop_all()

    def _holder(self) -> int:
        """The process that has bound the address; 0 if it is not known."""
        with suppress(OSError):
            self._socket.setblocking(False)
            self._socket.connect(self._address)
            shown = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
            return int(struct.unpack("3i", shown)[0])
        return 0

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._socket.close()


def connection_lock(connection: str) -> Lock | NameLock:
    """One service for each connection, whoever has started it."""
    name = f"offboard-{re.sub(r'[^A-Za-z0-9.]+', '-', connection)}"[:_NAME_MAX]
    what = f"connection {connection}"
    if _LINUX:
        return NameLock(name, what)
    return Lock(Path(tempfile.gettempdir()) / f"{name}.lock", what)


def directory_lock(place: Path) -> Lock:
    """One service for each directory of flights: two would overwrite each other's rolling log."""
    with suppress(OSError):  # opening says why
        place.mkdir(parents=True, exist_ok=True)
    return Lock(place / "service.lock", f"directory {place} (--out)")
