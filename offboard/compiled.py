"""Compilation by numba: two decorators, where the machine code is kept, and when it is made.

    PAIR = np.dtype([("total", "f8"), ("count", "i8")], align=True)

    @kernel
    def mean(pair):
        return pair.total / pair.count

    @entry(PAIR, array(1))
    def add(pairs, values):
        pair = pairs[0]
        for i in range(values.shape[0]):
            pair.total += values[i]
        pair.count += values.shape[0]
        return mean(pair)

    add(np.zeros(1, PAIR), np.ones(3))

A kernel is called by compiled code; called from Python it runs as Python. An entry is called from
Python. Its first call loads its machine code from disk, or compiles it with the kernels in it, for
seconds: `prepare` before anything that must not wait. Importing compiles nothing and does not
import numba. numba notices when the source file of an entry changed, not when that of a kernel did:
so the directory of the machine code is named after all sources that are compiled.
"""

from __future__ import annotations

import fcntl
import functools
import gc
import hashlib
import importlib
import os
import re
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, Generic, ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")
F = TypeVar("F", bound=Callable[..., Any])

Parameter = type[int] | type[float] | np.dtype[Any] | tuple[int, np.dtype[Any]]
"""Of an entry: a number, an array of one record, or an array: its dimensions and dtype."""

ENTRIES_PER_PROCESS = 3  # a process takes a second to start
VERSIONS_KEPT = 5

_entries: list[Entry[Any, Any]] = []
_kernels: list[Callable[..., Any]] = []  # that numba does not know yet


def kernel(function: F) -> F:
    """Decorator: a function for entries and other kernels to call."""
    _kernels.append(function)
    return function


def array(dimensions: int, dtype: str = "f8") -> Parameter:
    """Parameter of an entry: a C-contiguous array."""
    return dimensions, np.dtype(dtype)


def entry(*parameters: Parameter) -> Callable[[Callable[P, R]], Entry[P, R]]:
    """Decorator: a function for Python to call, with one parameter per argument: `int`, `float`,
    `array(dimensions)`, or a dtype, which stands for an array of one such record."""
    return lambda function: Entry(function, parameters)


class Entry(Generic[P, R]):
    """A function in machine code. Arguments of other types raise TypeError."""

    def __init__(self, function: Callable[P, R], parameters: tuple[Parameter, ...]) -> None:
        self._function, self._parameters = function, parameters
        self._code: Callable[P, R] | None = None
        functools.update_wrapper(self, function)
        _entries.append(self)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        code = self._code or self.load()
        return code(*args, **kwargs)

    @property
    def _mark(self) -> Path:
        """A file that is locked while the machine code is made, and not empty afterwards."""
        return directory() / f"{self.__module__}.{self.__name__}"

    @property
    def on_disk(self) -> bool:
        """Whether the machine code was made before."""
        return self._mark.exists() and self._mark.stat().st_size > 0

    def load(self, wait: bool = True) -> Callable[P, R]:
        """The machine code, from disk or newly compiled. Raises BlockingIOError where another
        process is compiling it, unless it is to `wait` for that."""
        with self._mark.open("a") as mark:
            fcntl.flock(mark, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
            with _without_garbage_collection():
                self._code = code = self._compile()
            if mark.tell() == 0:
                mark.write("compiled")
        return code

    def _compile(self) -> Callable[P, R]:
        import numba
        from numba.extending import register_jitable

        while _kernels:
            register_jitable(error_model="numpy")(_kernels.pop())
        signature = tuple(map(_numba_type, self._parameters))
        others, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(directory())
        try:
            return numba.njit(signature, cache=True, error_model="numpy")(self._function)
        finally:
            numba.config.CACHE_DIR = others


def _numba_type(parameter: Parameter) -> Any:
    from numba import float64, from_dtype, int64, types

    if isinstance(parameter, type):
        return {int: int64, float: float64}[parameter]
    dimensions, dtype = parameter if isinstance(parameter, tuple) else (1, parameter)
    return types.Array(from_dtype(dtype), dimensions, "C")


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """numba makes so many objects that a third of the time of loading goes there."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def prepare(tell: Callable[[str], None] = lambda sentence: None) -> None:
    """Compile the entries of all modules imported so far that are not on disk, in several
    processes. `tell` is given a sentence for the user before that."""
    missing = [each for each in _entries if not each.on_disk]
    if not missing:
        return
    tell("first run on this machine: compiling, about 15 s")
    modules = sorted({each.__module__ for each in missing})
    command = (sys.executable, "-P", "-m", "offboard.compiled", *modules)
    found = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    silent = subprocess.DEVNULL
    helpers = [
        subprocess.Popen(command, env=found, stdin=silent, stdout=silent, stderr=silent)
        for _ in range(1, min(os.cpu_count() or 1, len(missing) // ENTRIES_PER_PROCESS))
    ]
    _compile_free(missing)
    for helper in helpers:
        helper.wait()


def main(modules: Sequence[str]) -> None:
    """`python -m offboard.compiled MODULE...`: compile the entries that these modules take."""
    for name in modules:
        importlib.import_module(name)
    _compile_free(_entries)


def _compile_free(entries: Iterable[Entry[Any, Any]]) -> None:
    """Compile those that are not on disk and that no other process is compiling."""
    for each in entries:
        if not each.on_disk:
            with suppress(BlockingIOError):
                each.load(wait=False)


@functools.cache
def directory() -> Path:
    """Of the machine code: private, in NUMBA_CACHE_DIR, XDG_CACHE_HOME or ~/.cache, where these
    are absolute and writable; else one for this process."""
    bases = (os.environ.get("NUMBA_CACHE_DIR"), os.environ.get("XDG_CACHE_HOME"), "~/.cache")
    for base in (Path(each).expanduser() / "pso-offboard" for each in bases if each):
        place = base / _digest()
        if base.is_absolute() and _is_private(base) and _is_private(place):
            os.utime(place)
            versions = sorted(base.iterdir(), key=lambda each: each.stat().st_mtime)
            for old in versions[:-VERSIONS_KEPT]:
                shutil.rmtree(old, ignore_errors=True)
            return place
    return Path(tempfile.mkdtemp(prefix="pso-offboard-"))


def _is_private(place: Path) -> bool:
    """Make the directory; whether nobody else may write there: what is read is executed."""
    try:
        for part in (*reversed(place.parents), place):
            part.mkdir(mode=0o700, exist_ok=True)  # whatever the umask
        tempfile.TemporaryFile(dir=place).close()
        status = place.lstat()
    except OSError:
        return False
    ours = stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid()
    return ours and not status.st_mode & 0o022


def _digest() -> str:
    """Of the versions of Python and numba, and of all modules with entries or kernels and those
    whose constants they take, which are compiled in."""
    root = Path(__file__).parents[1]
    sources = {
        path.relative_to(root).as_posix(): path.read_bytes()
        for package in ("offboard", "simulator")
        for path in (root / package).rglob("*.py")
    }
    pending = [name for name, source in sources.items() if _COMPILED.search(source)]
    taken: set[str] = set()
    while pending:
        taken.add(name := pending.pop())
        for module, names in _IMPORT.findall(sources[name]):
            path = module.decode().replace(".", "/") + ".py"
            if _CONSTANT.search(names) and path in sources.keys() - taken:
                pending.append(path)
    digest = hashlib.sha256(f"{sys.implementation.cache_tag} {version('numba')}".encode())
    for name in sorted(taken):
        digest.update(name.encode() + b"\0" + sources[name])
    return digest.hexdigest()[:16]


_COMPILED = re.compile(rb"^@(?:entry|kernel)\b", re.M)
_IMPORT = re.compile(rb"^from ((?:offboard|simulator)[.\w]*) import (\([^)]*\)|.*)", re.M)
_CONSTANT = re.compile(rb"\b[A-Z][A-Z0-9_]*\b")

if __name__ == "__main__":
    # As imported, not as run: the entries are there
    from offboard.compiled import main as compile_modules

    compile_modules(sys.argv[1:])
