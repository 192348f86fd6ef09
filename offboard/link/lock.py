"""Locks that allow one service for each vehicle on a connection and for each directory.

The kernel releases a lock when the process that holds it ends, also if it was killed.
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
_NAME_MAX = 90  # characters; an abstract address has at most 107
_REFUSED_MAX = 4096  # backlog: refused services that can still find out who holds a lock


def _held(what: str, holder: int | str) -> Unavailable:
    """The error for a lock that another service holds."""
    return Unavailable(f"another service has the {what}: process {holder or 'unknown'}")


@contextmanager
def file_lock(path: Path, what: str) -> Iterator[None]:
    """Hold a lock on the file at `path`. The file is not removed: it keeps the id of the last
    process that held the lock. `what` names in errors what the lock protects. Raises UserError."""
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
    """Hold a lock, as `file_lock`, but on an abstract Unix address (Linux only). All users and
    units see it, and it belongs to a network namespace, as ports do. Raises Unavailable."""
    with socket.socket(socket.AF_UNIX) as held:
        try:
            held.bind(f"\0{name}")
            held.listen(_REFUSED_MAX)
        except OSError:
            raise _held(what, _holder(held, f"\0{name}")) from None
        yield


def _holder(unbound: socket.socket, address: str) -> int:
    """Id of the process that has bound `address`; 0 if it is not known."""
    with suppress(OSError):
        unbound.setblocking(False)
        unbound.connect(address)
        shown = unbound.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
        return int(struct.unpack("3i", shown)[0])
    return 0


def connection_lock(connection: str, system_id: int | None = None) -> AbstractContextManager[None]:
    """The lock that allows one service for each connection, whichever user has started it. On a
    connection to a TCP server it allows one for each `--system`: a router has many vehicles."""
    which = f"{system_id or 0}-" if connection.startswith("tcp:") else ""
    name = f"offboard-{which}{re.sub(r'[^A-Za-z0-9.]+', '-', connection)}"[:_NAME_MAX]
    what = f"connection {connection}" + (f" --system {system_id}" if which and system_id else "")
    if _LINUX:
        return name_lock(name, what)
    return file_lock(Path(tempfile.gettempdir()) / f"{name}.lock", what)


def directory_lock(place: Path) -> AbstractContextManager[None]:
    """The lock that allows one service for each directory of flights, because two would overwrite
    each other's rolling log."""
    with suppress(OSError):  # if this fails, opening the lock reports why
        place.mkdir(parents=True, exist_ok=True)
    return file_lock(place / "service.lock", f"directory {place} (--out)")
