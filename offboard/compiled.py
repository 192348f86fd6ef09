"""Compilation by numba: `@kernel` for functions that compiled code calls, `@entry` for functions
that Python calls.

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

The first call of an entry loads its machine code from disk or compiles it, which takes up to some
seconds; `prepare` does this in advance for all entries. Importing a module with entries does not
import numba. With NUMBA_DISABLE_JIT=1 all functions run as Python, slowly, and a debugger can step
through them.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, Generic, ParamSpec, TypeVar, cast

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")
F = TypeVar("F", bound=Callable[..., Any])

Parameter = type[int | float] | np.dtype[Any] | tuple[int, np.dtype[Any]]
"""A number, the dtype of an array of one record, or the dimensions and dtype of an array."""

defined: list[Entry[Any, Any]] = []  # the entries of the modules imported so far
_kernels: list[Callable[..., Any]] = []  # kernels not yet registered with numba
_COMPILES = re.compile(rb"^from offboard\.compiled import .*\b(?:entry|kernel)\b", re.M)
_IMPORT = re.compile(rb"^from ((?:offboard|simulator)[.\w]+) import", re.M)


def kernel(function: F) -> F:
    """Decorator of a function that entries and other kernels call. Called from Python, it runs as
    Python."""
    _kernels.append(function)
    return function


def array(dimensions: int, dtype: str | np.dtype[Any] = "f8") -> Parameter:
    """Return the parameter of an entry that is a C-contiguous array."""
    return dimensions, np.dtype(dtype)


def entry(*parameters: Parameter) -> Callable[[Callable[P, R]], Entry[P, R]]:
    """Decorator of a function that Python calls; `parameters` has one for each argument."""
    return lambda function: Entry(function, parameters)


class Entry(Generic[P, R]):
    """A compiled function. Calling it with arguments of other types raises TypeError, so that
    nothing is compiled in flight."""

    def __init__(self, function: Callable[P, R], parameters: tuple[Parameter, ...]) -> None:
        self.name = f"{function.__module__}.{function.__name__}"
        self.machine_code: Callable[P, R] | None = None  # once it is loaded
        self._function, self._parameters = function, parameters
        functools.update_wrapper(self, function)
        defined.append(self)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        return (self.machine_code or self.load())(*args, **kwargs)

    @property
    def is_compiled(self) -> bool:
        """Whether the machine code is loaded or on disk."""
        return self.machine_code is not None or (directory() / self.name).exists()

    def load(self) -> Callable[P, R]:
        """Load the machine code from disk, or compile it, and return it."""
        import numba  # takes half a second
        from numba.extending import register_jitable

        config: Any = numba.config
        if config.DISABLE_JIT:
            self.machine_code = self._interpreted
            return self._interpreted
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
        """Run the function as Python, with the fields of records as attributes, as in numba."""
        views: Any = (
            each.view(np.recarray) if isinstance(each, np.ndarray) and each.dtype.names else each
            for each in args
        )
        return self._function(*views, **kwargs)


def _numba_type(parameter: Parameter) -> Any:
    from numba import float64, from_dtype, int64, types

    if isinstance(parameter, type):
        return {int: int64, float: float64}[parameter]
    dimensions, dtype = parameter if isinstance(parameter, tuple) else (1, parameter)
    return types.Array(from_dtype(dtype), dimensions, "C")


def prepare(tell: Callable[[str], None] = lambda sentence: None) -> None:
    """Load the entries of all imported modules. If any has to be compiled, `tell` is called before
    with a sentence for the user."""
    if not all(each.is_compiled for each in defined):
        tell("first flight with this code: compiling it to machine code once, about 10 s")
    for each in defined:
        if each.machine_code is None:
            each.load()


@functools.cache
def directory() -> Path:
    """Return the directory of the machine code: below the first of NUMBA_CACHE_DIR, XDG_CACHE_HOME
    and ~/.cache that is absolute (as the XDG standard requires) and writable, or else in the
    directory for temporary files.

    Its name is a hash of this installation, the version of numba, the sources with compiled
    functions and the modules that these import. Numba itself compiles an entry again only if the
    file of the entry has changed, not if that of a kernel or a constant has.
    """
    root = Path(__file__).parents[1]
    packages = (root / package for package in ("offboard", "simulator"))
    texts = {path: path.read_bytes() for package in packages for path in package.rglob("*.py")}
    used = {path for path, text in texts.items() if _COMPILES.search(text)}
    for path in tuple(used):
        modules = (name.decode().replace(".", "/") for name in _IMPORT.findall(texts[path]))
        used.update({root / f"{module}.py" for module in modules} & texts.keys())
    compiler = f"{root} {sys.implementation.cache_tag} {version('numba')}".encode()
    hashed = hashlib.sha256(b"\0".join((compiler, *(texts[path] for path in sorted(used)))))
    name = hashed.hexdigest()[:16]
    given = (os.environ.get(key, "") for key in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"))
    for cache in filter(os.path.isabs, (*given, os.path.expanduser("~/.cache"))):
        if _writable(place := Path(cache) / "pso-offboard" / name):
            return place
    place = Path(tempfile.gettempdir()) / f"pso-offboard-{os.getuid()}-{name}"
    # all users can write there: machine code of another user must not be run
    ours = _writable(place) and place.lstat().st_uid == os.getuid()
    return place if ours else Path(tempfile.mkdtemp())


def _writable(place: Path) -> bool:
    with suppress(OSError):
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=place).close()
        return True
    return False
