"""Compilation by numba: two decorators, when functions are compiled, where machine code is kept.

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

A kernel is called by compiled functions; called from Python it runs as Python. An entry is called
from Python: the first call loads it from disk, or compiles it and its kernels, for seconds. Before
anything that must not wait, `prepare` compiles the entries of all modules that are imported.
Importing a module neither compiles nor imports numba.

numba recompiles an entry when its source file has changed, but not when that of a kernel has. So
machine code is kept in a directory that is named after all compiled sources.
"""

from __future__ import annotations

import atexit
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
from typing import Any, Generic, ParamSpec, TypeVar, cast

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")
F = TypeVar("F", bound=Callable[..., Any])

Parameter = type[int | float | np.random.Generator] | np.dtype[Any] | tuple[int, np.dtype[Any]]
"""A number, a random generator, the dtype of an array of one record, or the dimensions and dtype of
an array."""

ENTRIES_PER_PROCESS = 3  # starting a process costs as much as compiling one of them
UNUSED_S = 30 * 86400.0  # machine code that was not used for so long is deleted

defined: list[Entry[Any, Any]] = []  # the entries of the modules imported so far
_kernels: list[Callable[..., Any]] = []  # not yet registered with numba


def kernel(function: F) -> F:
    """Decorator of a function that entries and other kernels call."""
    _kernels.append(function)
    return function


def array(dimensions: int, dtype: str | np.dtype[Any] = "f8") -> Parameter:
    """Parameter of an entry: a C-contiguous array."""
    return dimensions, np.dtype(dtype)


def entry(*parameters: Parameter) -> Callable[[Callable[P, R]], Entry[P, R]]:
    """Decorator of a function that Python calls. There is one parameter per argument: `int`,
    `float`, `np.random.Generator`, `array(dimensions)`, or a dtype for an array of one record."""
    return lambda function: Entry(function, parameters)


class Entry(Generic[P, R]):
    """A compiled function. Calling it with arguments of other types raises TypeError."""

    def __init__(self, function: Callable[P, R], parameters: tuple[Parameter, ...]) -> None:
        self.name = f"{function.__module__}.{function.__name__}"
        self.machine_code: Callable[P, R] | None = None  # once it is loaded
        self._function, self._parameters = function, parameters
        functools.update_wrapper(self, function)
        defined.append(self)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        code = self.machine_code or self.load()
        return code(*args, **kwargs)

    @property
    def is_compiled(self) -> bool:
        """Whether its machine code is on disk."""
        mark = directory() / self.name
        return mark.exists() and mark.stat().st_size > 0

    def load(self, wait: bool = True) -> Callable[P, R]:
        """The machine code, from disk or compiled now. Raises BlockingIOError while another process
        compiles it, unless it may `wait` for that."""
        with (directory() / self.name).open("a") as mark:  # not empty once it is compiled
            fcntl.flock(mark, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
            with loading():
                code = self.machine_code = self._compile()
            if mark.tell() == 0:
                mark.write("compiled\n")
        return code

    def _compile(self) -> Callable[P, R]:
        import numba
        from numba.extending import register_jitable

        while _kernels:
            register_jitable(error_model="numpy")(_kernels.pop())
        signature = tuple(map(_numba_type, self._parameters))
        config: Any = numba.config
        others, config.CACHE_DIR = config.CACHE_DIR, str(directory())
        try:
            jitted = numba.njit(signature, cache=True, error_model="numpy")(self._function)
        finally:
            config.CACHE_DIR = others
        return cast(Callable[P, R], jitted)


@contextmanager
def loading() -> Iterator[None]:
    """Import modules or load machine code without garbage collection, which takes up to a third of
    the time: many objects are created and nearly none is garbage. Later collections skip them."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if collects:
            gc.enable()


def _numba_type(parameter: Parameter) -> Any:
    from numba import float64, from_dtype, int64, typeof, types

    if isinstance(parameter, type):
        generator = typeof(np.random.default_rng())
        return {int: int64, float: float64, np.random.Generator: generator}[parameter]
    dimensions, dtype = parameter if isinstance(parameter, tuple) else (1, parameter)
    return types.Array(from_dtype(dtype), dimensions, "C")


def prepare(tell: Callable[[str], None] = lambda sentence: None) -> None:
    """Compile the entries of all imported modules, if they are not on disk, with one process per
    processor. `tell` is called with a sentence for the user before it takes long."""
    missing = [each for each in defined if not each.is_compiled]
    if not missing:
        return
    tell("first run on this machine: compiling, about 15 s")
    modules = sorted({each.__module__ for each in missing})
    command = (sys.executable, "-P", "-m", "offboard.compiled", *modules)
    ours = {
        "NUMBA_CACHE_DIR": str(directory().parents[1]),
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    silent = subprocess.DEVNULL
    others = [
        subprocess.Popen(command, env=os.environ | ours, stdin=silent, stdout=silent, stderr=silent)
        for _ in range(1, min(os.cpu_count() or 1, len(missing) // ENTRIES_PER_PROCESS))
    ]
    _compile_free(missing)
    for process in others:
        process.wait()


def _compile_free(entries: Iterable[Entry[Any, Any]]) -> None:
    """Compile the entries that are not on disk and that no other process is compiling."""
    for each in entries:
        if not each.is_compiled:
            with suppress(BlockingIOError):
                each.load(wait=False)


def main(modules: Sequence[str]) -> None:
    """`python -m offboard.compiled MODULE...`: compile the entries that these modules import."""
    for name in modules:
        importlib.import_module(name)
    _compile_free(defined)


@functools.cache
def directory() -> Path:
    """Where machine code of these sources is kept: below the first of NUMBA_CACHE_DIR,
    XDG_CACHE_HOME and ~/.cache that is absolute and in which only this user can write, otherwise
    in a temporary directory of this process."""
    given = [os.environ.get(name, "") for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")]
    for cache in filter(os.path.isabs, (*given, os.path.expanduser("~/.cache"))):
        versions = Path(cache) / "pso-offboard"
        if _is_private(versions) and _is_private(versions / _digest()):
            place = versions / _digest()
            os.utime(place)
            for each in versions.iterdir():  # every start touches the one that it uses
                if each.stat().st_mtime < place.stat().st_mtime - UNUSED_S:
                    shutil.rmtree(each, ignore_errors=True)
            return place
    temporary = tempfile.mkdtemp()
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    place = Path(temporary) / "pso-offboard" / _digest()
    place.mkdir(mode=0o700, parents=True)
    return place


def _is_private(place: Path) -> bool:
    """Make the directory; whether only this user can write in it: machine code is executed."""
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=place).close()
        status = place.lstat()
    except OSError:
        return False
    ours = stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid()
    return ours and not status.st_mode & 0o022


_COMPILED = re.compile(rb"^@(?:entry|kernel)\b", re.M)
_IMPORT = re.compile(rb"^from ((?:offboard|simulator)[.\w]*) import (\([^)]*\)|.*)", re.M)
_CONSTANT = re.compile(rb"\b[A-Z][A-Z0-9_]*\b")


@functools.cache
def _digest() -> str:
    """A hash of the versions of Python and numba, the modules with entries or kernels, and the
    modules that they import constants from, because constants are compiled in."""
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
    digest = hashlib.sha256(f"{root} {sys.implementation.cache_tag} {version('numba')}".encode())
    for name in sorted(taken):
        digest.update(name.encode() + b"\0" + sources[name])
    return digest.hexdigest()[:16]


if __name__ == "__main__":
    from offboard.compiled import main as compile_modules  # where the entries register themselves

    compile_modules(sys.argv[1:])
