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
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

from offboard.documents.errors import Unavailable, UserError

_LINUX = sys.platform == "linux"
_NAME_MAX = 90  # of 107 characters of an abstract address
_REFUSED_MAX = 4096  # services that are told who holds a lock


def _held(what: str, holder: int | str) -> Unavailable:
    """Another service has it."""
    return Unavailable(f"another service has the {what}: process {holder or 'unknown'}")


@contextmanager
def file_lock(path: Path, what: str) -> Iterator[None]:
    """The file stays, with the number of the last process: the kernel releases the lock with the
    process. `what`: what the lock protects, named in the error. Raises UserError."""
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise UserError(f"the lock {path} cannot be opened: {error.strerror}") from None
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            holder = os.read(descriptor, 20).decode(errors="replace").strip()
            raise _held(what, holder) from None
        os.ftruncate(descriptor, 0)
        os.write(descriptor, f"{os.getpid()}\n".encode())
        yield
    finally:
        os.close(descriptor)


@contextmanager
def name_lock(name: str, what: str) -> Iterator[None]:
    """As `file_lock`, but by an abstract Unix address (Linux), which all users and units see, and
    which belongs to a network namespace as ports do. Raises Unavailable."""
    with socket.socket(socket.AF_UNIX) as held:
        try:
            held.bind(f"\0{name}")
            held.listen(_REFUSED_MAX)
        except OSError:
            raise _held(what, _holder(held, f"\0{name}")) from None
        yield


def _holder(unbound: socket.socket, address: str) -> int:
    """The process that has bound the address; 0 if it is not known."""
    with suppress(OSError):
        unbound.setblocking(False)
        unbound.connect(address)
        shown = unbound.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
        return int(struct.unpack("3i", shown)[0])
    return 0


def connection_lock(connection: str) -> AbstractContextManager[None]:
    """One service for each connection, whoever has started it."""
    name = f"offboard-{re.sub(r'[^A-Za-z0-9.]+', '-', connection)}"[:_NAME_MAX]
    what = f"connection {connection}"
    if _LINUX:
        return name_lock(name, what)
    return file_lock(Path(tempfile.gettempdir()) / f"{name}.lock", what)


def directory_lock(place: Path) -> AbstractContextManager[None]:
    """One service for each directory of flights: two would overwrite each other's rolling log."""
    with suppress(OSError):  # opening says why
        place.mkdir(parents=True, exist_ok=True)
    return file_lock(place / "service.lock", f"directory {place} (--out)")
