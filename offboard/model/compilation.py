"""Where compiled functions are cached on disk, settled before numba is first imported.

numba left alone has two faults here: with source tree and home directory both read-only,
`njit(cache=True)` raises on import; and a cached function never notices that a compiled function
it calls, in another file, has changed. Hence a directory of our own, named after the content of
all compiled sources. The user's NUMBA_CACHE_DIR has precedence.
"""

from __future__ import annotations

import functools
import hashlib
import os
import stat
import sys
import tempfile
from collections.abc import Iterator, Sequence
from importlib.abc import MetaPathFinder
from pathlib import Path
from types import ModuleType

_VARIABLE = "NUMBA_CACHE_DIR"


def prepare_cache() -> Path:
    """Point numba at a writable cache directory for exactly these sources, and return it.

    Idempotent, cheap (no import of numba). Call before the first `njit(cache=True)`.
    """
    chosen = os.environ.get(_VARIABLE)
    if not chosen:
        chosen = str(_writable_directory(sources_digest()))
        os.environ[_VARIABLE] = chosen
    numba = sys.modules.get("numba")
    if numba is not None:  # imported before us: it has read its environment already
        numba.config.CACHE_DIR = chosen
    return Path(chosen)


class _BeforeNumba(MetaPathFinder):
    """Prepares the cache when somebody imports numba, and finds nothing itself."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> None:
        if fullname == "numba" and self in sys.meta_path:
            sys.meta_path.remove(self)
            prepare_cache()


def prepare_before_numba() -> None:
    """Have `prepare_cache` called before numba is imported; now, when it already is.

    Not at once, because whoever only loads our pytest plugins shall not pay for it.
    """
    if "numba" in sys.modules:
        prepare_cache()
    elif not any(isinstance(finder, _BeforeNumba) for finder in sys.meta_path):
        sys.meta_path.insert(0, _BeforeNumba())


@functools.cache
def sources_digest() -> str:
    """Hash of every module beside us that compiles something: their caches stand or fall as one."""
    root = Path(__file__).resolve().parents[2]
    digest = hashlib.sha256()
    for package in ("offboard", "simulator"):
        for path in sorted((root / package).rglob("*.py")):
            content = path.read_bytes()
            if b"njit" in content or b"@kernel" in content:
                digest.update(str(path.relative_to(root)).encode() + b"\0" + content)
    return digest.hexdigest()[:16]


def _writable_directory(name: str) -> Path:
    for base in _bases():
        directory = base / name
        try:
            base.parent.mkdir(parents=True, exist_ok=True)
            base.mkdir(mode=0o700, exist_ok=True)
            directory.mkdir(exist_ok=True)
            if is_private(base):
                with tempfile.TemporaryFile(dir=directory):
                    return directory
        except OSError:
            continue
    return Path(tempfile.mkdtemp(prefix="pso-offboard-"))


def _bases() -> Iterator[Path]:
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    yield Path(cache) / "pso-offboard"
    yield Path(tempfile.gettempdir()) / f"pso-offboard-{_user()}"


def is_private(directory: Path) -> bool:
    """Cached code is executed: a directory another user owns or can write to is not for us."""
    status = directory.lstat()
    ours = os.name != "posix" or status.st_uid == _user()
    return stat.S_ISDIR(status.st_mode) and ours and not status.st_mode & 0o022


def _user() -> int:
    return os.getuid() if hasattr(os, "getuid") else 0
