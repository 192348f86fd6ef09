"""Where compiled functions are cached on disk, settled before numba is first imported.

numba left alone has two faults here: with source tree and home directory both read-only,
`njit(cache=True)` raises on import; and a cached function never notices that a compiled function
it calls, in another file, has changed. Hence a directory of our own, named after the content of
all compiled sources. The user's NUMBA_CACHE_DIR has precedence.
"""

from __future__ import annotations

import functools
import gc
import hashlib
import os
import re
import stat
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import MetaPathFinder
from pathlib import Path
from types import ModuleType

_VARIABLE = "NUMBA_CACHE_DIR"
_COMPILES = re.compile(rb"njit|^@(?:kernel|entry)", re.M)
_IMPORT = re.compile(rb"^from ((?:offboard|simulator)[.\w]*) import (\([^)]*\)|.*)", re.M)
_CONSTANT = re.compile(rb"\b[A-Z][A-Z0-9_]+\b")


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


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Round what may compile: numba makes so many objects that a tenth of its time goes there."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@functools.cache
def sources_digest() -> str:
    """Hash of every module that compiles something, and of those whose constants it takes: their
    machine code stands or falls as one."""
    root = Path(__file__).resolve().parents[2]
    sources = {
        path.relative_to(root).as_posix(): path.read_bytes()
        for package in ("offboard", "simulator")
        for path in (root / package).rglob("*.py")
    }
    pending = [name for name, content in sources.items() if _COMPILES.search(content)]
    taken: set[str] = set()
    while pending:
        taken.add(name := pending.pop())
        for module, names in _IMPORT.findall(sources[name]):
            source = module.decode().replace(".", "/") + ".py"
            if _CONSTANT.search(names) and source in sources and source not in taken:
                pending.append(source)
    digest = hashlib.sha256()
    for name in sorted(taken):
        digest.update(name.encode() + b"\0" + sources[name])
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
