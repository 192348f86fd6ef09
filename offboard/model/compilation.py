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
_COMPILES = re.compile(rb"njit|llvmlite|^@(?:kernel|entry)", re.M)
_ENTRY = re.compile(rb"^@entry", re.M)
_IMPORT = re.compile(rb"^from ((?:offboard|simulator)[.\w]*) import (\([^)]*\)|.*)", re.M)
_CONSTANT = re.compile(rb"\b[A-Z][A-Z0-9_]+\b")


def prepare_cache() -> Path:
    """Point numba at a writable, private cache directory for exactly these sources; return it.

    Idempotent, cheap (no import of numba). Call before the first `njit(cache=True)`. Says on
    standard error when the user's choice cannot be used.
    """
    directory = _settled(os.environ.get(_VARIABLE, ""))
    os.environ[_VARIABLE] = str(directory)
    numba = sys.modules.get("numba")
    if numba is not None:  # imported before us: it has read its environment already
        numba.config.CACHE_DIR = str(directory)
    return directory


@functools.cache
def _settled(chosen: str) -> Path:
    wanted = Path(chosen).resolve()
    trouble = _trouble(wanted) if chosen else ""
    if chosen and not trouble:
        return wanted
    directory = _own_directory(sources_digest())
    if trouble:
        print(
            f"{_VARIABLE}={chosen} is not used: {trouble}; compiled code is kept in {directory}",
            file=sys.stderr,
        )
    return directory


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
    sources = _sources()
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


def entry_modules() -> list[str]:
    """The modules with functions that are compiled for Python to call."""
    return sorted(
        name.removesuffix(".py").replace("/", ".")
        for name, content in _sources().items()
        if _ENTRY.search(content)
    )


def _sources() -> dict[str, bytes]:
    root = Path(__file__).resolve().parents[2]
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for package in ("offboard", "simulator")
        for path in (root / package).rglob("*.py")
    }


def _own_directory(name: str) -> Path:
    for base in _bases():
        if not (_trouble(base) or _trouble(base / name)):
            return base / name
    return Path(tempfile.mkdtemp(prefix="pso-offboard-"))


def _trouble(directory: Path) -> str:
    """Why no code can be kept there, or "". What is missing of it is made."""
    try:
        for part in (*reversed(directory.parents), directory):
            part.mkdir(mode=0o700, exist_ok=True)  # for us alone, whatever the umask
        if not _is_private(directory):
            return "others can write to it"
        with tempfile.TemporaryFile(dir=directory):
            return ""
    except OSError as error:
        return f"it cannot be written ({error.strerror})"


def _bases() -> Iterator[Path]:
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    yield Path(cache) / "pso-offboard"
    yield Path(tempfile.gettempdir()) / f"pso-offboard-{_user()}"


def _is_private(directory: Path) -> bool:
    """Cached code is executed: a directory another user owns or can write to is not for us."""
    status = directory.lstat()
    ours = os.name != "posix" or status.st_uid == _user()
    return stat.S_ISDIR(status.st_mode) and ours and not status.st_mode & 0o022


def _user() -> int:
    return os.getuid() if hasattr(os, "getuid") else 0
