"""Where machine code is kept on disk: a directory of the user's own, for exactly these sources."""

from __future__ import annotations

import functools
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from offboard.model import sources


@functools.cache
def directory() -> Path:
    """Writable and private, made when it is not there: `pso-offboard` and the sources' digest
    under XDG_CACHE_HOME or ~/.cache, otherwise under the directory for temporary files."""
    for base in _bases():
        if _serves(base) and _serves(base / sources.digest()):
            return base / sources.digest()
    return Path(tempfile.mkdtemp(prefix="pso-offboard-"))


def _bases() -> Iterator[Path]:
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    yield Path(cache) / "pso-offboard"
    yield Path(tempfile.gettempdir()) / f"pso-offboard-{_user()}"


def _serves(place: Path) -> bool:
    """Whether code can be kept there. What is missing of it is made."""
    try:
        for part in (*reversed(place.parents), place):
            part.mkdir(mode=0o700, exist_ok=True)  # for us alone, whatever the umask
        with tempfile.TemporaryFile(dir=place):
            return _is_private(place)
    except OSError:
        return False


def _is_private(place: Path) -> bool:
    """Cached code is executed: a directory another user owns or can write to is not for us."""
    status = place.lstat()
    ours = os.name != "posix" or status.st_uid == _user()
    return stat.S_ISDIR(status.st_mode) and ours and not status.st_mode & 0o022


def _user() -> int:
    return os.getuid() if hasattr(os, "getuid") else 0
