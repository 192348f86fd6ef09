"""Compilation by numba: two decorators, and when functions are compiled.

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
from Python: the first call loads it from disk, or compiles it, for up to a second. Before anything
that must not wait, `prepare` loads the entries of all modules that are imported. Importing a module
neither compiles nor imports numba. With NUMBA_DISABLE_JIT=1 everything runs as Python, slowly, and
a debugger can step through it.

numba recompiles an entry when its source file has changed, but not when that of a kernel has. So
machine code is kept in a directory that is named after all compiled sources.
"""

from __future__ import annotations

import functools
import gc
import hashlib
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
        """Whether its machine code is on disk, or none is needed."""
        return self.machine_code is not None or (directory() / self.name).exists()

    def load(self) -> Callable[P, R]:
        """The machine code, from disk or compiled now."""
        import numba
        from numba.extending import register_jitable

        config: Any = numba.config
        if config.DISABLE_JIT:
            self.machine_code = self._interpreted
            return self._interpreted
        with loading():
            while _kernels:
                register_jitable(error_model="numpy")(_kernels.pop())
            signature = tuple(map(_numba_type, self._parameters))
            others, config.CACHE_DIR = config.CACHE_DIR, str(directory())
            try:
                jitted = numba.njit(signature, cache=True, error_model="numpy")(self._function)
            finally:
                config.CACHE_DIR = others
        (directory() / self.name).touch()
        self.machine_code = cast(Callable[P, R], jitted)
        return self.machine_code

    def _interpreted(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """The function as Python: a record has its fields as attributes there, too."""
        views: Any = (
            each.view(np.recarray) if isinstance(each, np.ndarray) and each.dtype.names else each
            for each in args
        )
        return self._function(*views, **kwargs)


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
    """Load the entries of all imported modules. `tell` is called with a sentence for the user
    before they are compiled."""
    if not all(each.is_compiled for each in defined):
        tell("first flight with this code: compiling it to machine code once, about 10 s")
    for each in defined:
        if each.machine_code is None:
            each.load()


@functools.cache
def directory() -> Path:
    """Where machine code of these sources is kept: below NUMBA_CACHE_DIR, XDG_CACHE_HOME or
    ~/.cache, or in a temporary directory where none of them can be written."""
    given = (os.environ.get("NUMBA_CACHE_DIR", ""), os.environ.get("XDG_CACHE_HOME", ""))
    for cache in filter(os.path.isabs, (*given, os.path.expanduser("~/.cache"))):
        place = Path(cache) / "pso-offboard" / _digest()
        try:
            place.mkdir(mode=0o700, parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=place).close()
        except OSError:
            continue
        return place
    return Path(tempfile.mkdtemp())


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
