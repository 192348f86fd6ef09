"""One service for each connection: a lock that its process holds, whatever becomes of it."""

from __future__ import annotations

import fcntl
import os
import re
import tempfile
from pathlib import Path
from types import TracebackType

from offboard.documents.errors import UserError


class Locked(UserError):
    """Another service has the connection: one sentence that says which process."""


def directory() -> Path:
    """Where locks are: the runtime directory of the service manager or of the user."""
    for name in ("RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR"):
        place = os.environ.get(name, "").split(":")[0]
        if place and os.access(place, os.W_OK | os.X_OK):
            return Path(place)
    return Path(tempfile.gettempdir())


class ConnectionLock:
    """Context manager; entering raises Locked. The file stays, with the number of the last process:
    the kernel releases the lock with the process."""

    def __init__(self, connection: str) -> None:
        self._connection = connection
        name = re.sub(r"[^A-Za-z0-9.]+", "-", connection)[:100]
        self.path = directory() / f"offboard-{os.getuid()}-{name}.lock"

    def __enter__(self) -> ConnectionLock:
        try:
            self._descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise Locked(f"the lock {self.path} cannot be opened: {error.strerror}") from None
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            holder = os.read(self._descriptor, 20).decode(errors="replace").strip() or "unknown"
            os.close(self._descriptor)
            raise Locked(
                f"another service has the connection {self._connection}: process {holder}"
            ) from None
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
