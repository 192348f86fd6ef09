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
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
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
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise UserError(f"cannot open {path}, the lock of the {what}: {error.strerror}") from None
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
def name_lock(name: str, excluded: Iterable[str], what: str) -> Iterator[None]:
    """Hold a lock, as `file_lock`, but on an abstract Unix address (Linux only), and only if nobody
    holds the locks `excluded`. All users and units see it, and it belongs to a network namespace,
    as ports do. Raises Unavailable."""
    with socket.socket(socket.AF_UNIX) as held:
        try:
            held.bind(f"\0{name}")
            held.listen(_REFUSED_MAX)
        except OSError:
            raise _held(what, _holder(name) or 0) from None
        for other in excluded:  # after `bind`: of two that start together, at least one is refused
            if (holder := _holder(other)) is not None:
                raise _held(what, holder)
        yield


def _holder(name: str) -> int | None:
    """Id of the process that holds a `name_lock`, 0 if it is not known; None if nobody does."""
    with socket.socket(socket.AF_UNIX) as client:
        client.setblocking(False)
        try:
            client.connect(f"\0{name}")
        except ConnectionRefusedError:
            return None
        except OSError:  # _REFUSED_MAX services have asked before, or we may not ask its holder
            return 0
        shown = client.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
        return int(struct.unpack("3i", shown)[0])


def connection_lock(connection: str, system_id: int | None = None) -> AbstractContextManager[None]:
    """The lock that allows one service for each connection, whichever user has started it. On a
    connection to a TCP server, as a router has many vehicles, it allows one for each `--system`, or
    one without it (Linux only: elsewhere one of each kind)."""
    name = f"offboard-{re.sub(r'[^A-Za-z0-9.]+', '-', connection)}"[:_NAME_MAX]
    what, excluded = f"connection {connection}", []
    if connection.startswith("tcp:"):
        name, *excluded = (f"{name}-{system}" for system in range(256))
        if system_id:
            name, excluded = excluded[system_id - 1], [name]
    if _LINUX:
        return name_lock(name, excluded, what)
    return file_lock(Path(tempfile.gettempdir()) / f"{name}.lock", what)


def directory_lock(place: Path) -> AbstractContextManager[None]:
    """The lock that allows one service for each directory of flights, because two would overwrite
    each other's rolling log."""
    return file_lock(place / "service.lock", f"directory {place} (--out)")
