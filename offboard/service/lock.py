"""One service for each connection and directory: locks that its process holds, whatever becomes of
it.
"""

from __future__ import annotations

import fcntl
import os
import re
import tempfile
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from offboard.documents.errors import UserError


class LockError(UserError):
    """A lock file that cannot be opened: one sentence for the user."""


class Locked(LockError):
    """Another service has it: one sentence that says which process."""

    is_usage = False


def directory() -> Path:
    """Where locks are: the runtime directory of the service manager or of the user."""
    for name in ("RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR"):
        place = os.environ.get(name, "").split(":")[0]
        if place and os.access(place, os.W_OK | os.X_OK):
            return Path(place)
    return Path(tempfile.gettempdir())


class Lock:
    """Context manager; entering raises Locked. The file stays, with the number of the last process:
    the kernel releases the lock with the process. `what` the lock is for, for the sentence."""

    def __init__(self, path: Path, what: str) -> None:
        self.path = path
        self._what = what

    def __enter__(self) -> Lock:
        try:
            self._descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise LockError(f"the lock {self.path} cannot be opened: {error.strerror}") from None
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            holder = os.read(self._descriptor, 20).decode(errors="replace").strip() or "unknown"
            os.close(self._descriptor)
            raise Locked(f"another service has the {self._what}: process {holder}") from None
        os.ftruncate(self._descriptor, 0)
        os.write(self._descriptor, f"{os.getpid()}\n".encode())
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        os.close(self._descriptor)


def connection_lock(connection: str) -> Lock:
    """One service for each connection. Ports belong to a network namespace, as of a container."""
    name, namespace = re.sub(r"[^A-Za-z0-9.]+", "-", connection)[:100], ""
    if not connection.startswith("serial:"):
        with suppress(OSError):  # Linux has them
            namespace = f"-{os.stat('/proc/self/ns/net').st_ino}"
    path = directory() / f"offboard-{os.getuid()}{namespace}-{name}.lock"
    return Lock(path, f"connection {connection}")


def directory_lock(place: Path) -> Lock:
    """One service for each directory of flights: two would overwrite each other's rolling log."""
    with suppress(OSError):  # opening says why
        place.mkdir(parents=True, exist_ok=True)
    return Lock(place / "service.lock", f"directory {place} (--out)")
