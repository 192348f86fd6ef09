"""Compiled functions for processes that must not pay for numba.

numba costs 100 MB and a third of a second of every start. A `Kernel` is a function for other
compiled functions to call. An `Entry` is what Python calls: its machine code, with that of all the
kernels in it, comes with the package as bitcode or is compiled once, is kept as an object file and
loaded by llvmlite alone. Entries take numbers, arrays and records (one-element structured arrays,
by address) and return a number; they allocate nothing and raise nothing. Called by their own names,
both run as Python: what the machine code does, step by step.
Knows neither vehicle nor controller.

What compiles in seconds: a function is compiled once for each type of its arguments, and of an
array in a record the size is part of the type; handed on as `record.array[:]` it is not.
"""

from __future__ import annotations

import ctypes
import functools
import os
import struct
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, ParamSpec, TypeVar, cast

import numpy as np

from offboard.model import bitcode, machine_code, shipped

P = ParamSpec("P")
R = TypeVar("R")
N = TypeVar("N", bound=float)

_COMPILE_ONE = """
import importlib, sys
from offboard.model.kernel import Entry

importlib.import_module(sys.argv[1])
Entry.compile_one(sys.argv[2])
"""


class Kernel(Generic[P, R]):
    """A function for compiled code to call; called from Python it runs as Python."""

    def __init__(self, function: Callable[P, R]) -> None:
        self.function = function
        functools.update_wrapper(self, function)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        return self.function(*args, **kwargs)

    @functools.cached_property
    def _numba_type_(self) -> Any:
        """As numba asks for it."""
        return bitcode.callee_type(self.function)


kernel = Kernel
"""The decorator."""


@dataclass(frozen=True, slots=True)
class ArrayKind:
    """A parameter that takes contiguous arrays of any lengths."""

    dimensions: int
    dtype: np.dtype[Any]

    def flat(self, value: np.ndarray[Any, Any]) -> tuple[int, ...]:
        """Address and lengths, as the machine code takes them. Raises TypeError for another kind of
        array, whose memory would be misread."""
        flags = value.flags
        if value.dtype != self.dtype or value.ndim != self.dimensions or not flags.c_contiguous:
            raise TypeError(
                f"compiled code takes a contiguous array of {self.dimensions} dimensions of"
                f" {self.dtype} here, not {value.ndim} of {value.dtype}, strides {value.strides}"
            )
        if flags.writeable and value.size:
            # A third of the next one's time
            place = ctypes.addressof(ctypes.c_char.from_buffer(cast(Any, value)))
        else:
            place = value.ctypes.data
        return (place, *value.shape)


def array(dimensions: int, dtype: str = "f8") -> ArrayKind:
    """A parameter of an entry: an array of so many dimensions."""
    return ArrayKind(dimensions, np.dtype(dtype))


Parameter = type[int] | type[float] | ArrayKind | np.dtype[Any]
"""Of an entry: a number, an array, or a record."""


class Entry(Generic[N]):
    """A function in machine code for Python to call, by `call`.

    Where it takes numbers and records alone, compiled code calls that same machine code; otherwise
    it is compiled anew with whoever calls it.
    """

    _defined: ClassVar[list[Entry[Any]]] = []
    compilations: ClassVar[int] = 0
    """How many entries numba compiled in this process."""

    def __init__(self, function: Callable[..., N], parameters: tuple[Parameter, ...]) -> None:
        self._function = function
        self._parameters = parameters
        returns = function.__annotations__.get("return", "int")
        self._returns = _NUMBERS[str(getattr(returns, "__name__", returns))]  # a type, or its name
        self._address: int | None = None
        Entry._defined.append(self)
        self.symbol = f"{function.__module__}.{function.__name__}"
        functools.update_wrapper(self, function)

    def __call__(self, *args: Any) -> N:
        """What the machine code does, as Python; records are given as their only element."""
        return self._function(*args)

    @functools.cached_property
    def call(self) -> Callable[..., N]:
        """The machine code: takes numbers, arrays, and records by `address`. It is loaded, or
        compiled when there is none, when first asked for."""
        function = self._machine_code
        if not self._takes_arrays:
            return function
        block_of = self._block_of

        def call(*args: Any) -> N:
            block = block_of(args)
            return function(block, block)

        return call

    def bound(self, *args: Any) -> Callable[[], N]:
        """`call` with the same arguments every time, in a fraction of its time; records are given
        as they are. What arrays and records hold may change from call to call; they live as long as
        this does. Raises TypeError for a record or an array of another kind."""
        given = list(args)
        for i, (each, arg) in enumerate(zip(self._parameters, args, strict=True)):
            if isinstance(each, np.dtype):
                if arg.dtype != each:
                    raise TypeError(f"argument {i} of {self.symbol} is a record of another kind")
                given[i] = address(arg)
        block = self._block_of(given)
        call = functools.partial(
            self._machine_code, *((block, block) if self._takes_arrays else given)
        )
        vars(call)["held"] = args
        return call

    @functools.cached_property
    def _block_of(self) -> Callable[[Sequence[Any]], bytes]:
        """All arguments as machine code takes them where there are arrays among them."""
        flatteners = [_flattener(parameter) for parameter in self._parameters]
        packed = struct.Struct("=" + "".join(map(_layout, self._parameters))).pack

        def block_of(args: Sequence[Any]) -> bytes:
            flat: list[Any] = []
            for flatten, arg in zip(flatteners, args, strict=True):
                flat += flatten(arg)
            return packed(*flat)

        return block_of

    @functools.cached_property
    def _machine_code(self) -> Callable[..., N]:
        """Takes numbers and the addresses of records; or, where there are arrays, one block with
        all of these, twice."""
        kinds = [_C_TYPES.get(parameter, ctypes.c_void_p) for parameter in self._parameters]
        if self._takes_arrays:
            kinds = [ctypes.c_void_p, ctypes.c_void_p]
        prototype = ctypes.CFUNCTYPE(_C_TYPES[self._returns], *kinds)
        return cast(Callable[..., N], prototype(self._load()))

    @property
    def _takes_arrays(self) -> bool:
        return any(isinstance(parameter, ArrayKind) for parameter in self._parameters)

    @classmethod
    def defined(cls) -> tuple[Entry[Any], ...]:
        """All of them in the modules imported so far."""
        return tuple(cls._defined)

    @classmethod
    def all_compiled(cls) -> bool:
        """Whether none of the entries defined so far is left to numba."""
        return not cls._to_compile()

    @classmethod
    def _to_compile(cls) -> list[Entry[Any]]:
        there = (machine_code.kept, shipped.read)
        return [
            entry
            for entry in cls._defined
            if entry._address is None and not any(look(entry.symbol) for look in there)
        ]

    @classmethod
    def compile_all(cls) -> None:
        """Compile what is left to numba; the last entry in another process, which halves the
        time."""
        missing = cls._to_compile()
        if not missing:
            return
        *others, last = missing
        command = (sys.executable, "-c", _COMPILE_ONE, last.__module__, last.symbol)
        found = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
        silent = subprocess.DEVNULL
        with subprocess.Popen(command, env=found, stdin=silent, stdout=silent, stderr=silent):
            for entry in others:
                entry._load()
        last._load()  # compiles it after all where the other process could not

    @classmethod
    def compile_one(cls, symbol: str) -> None:
        """Compile this entry and keep it, in a process that does not call it."""
        (entry,) = (each for each in cls._defined if each.symbol == symbol)
        machine_code.keep(symbol, machine_code.emitted(entry.bitcode()))

    def _load(self) -> int:
        """The address of the machine code in this process."""
        if self._address is None:
            code = machine_code.kept(self.symbol)
            if code is None:
                code = machine_code.emitted(shipped.read(self.symbol) or self.bitcode())
                machine_code.keep(self.symbol, code)
            for entry in self._defined:
                if entry is not self and machine_code.names(code, entry.symbol):
                    entry._load()  # before whoever calls it
            self._address = machine_code.load(self.symbol, code)
        return self._address

    def bitcode(self) -> bytes:
        """Compiled by numba, for any processor of this one's kind."""
        Entry.compilations += 1
        for entry in self._defined:
            if entry._address is None:
                machine_code.pretend(entry.symbol)  # numba looks up what nobody calls
        return bitcode.compiled(self._function, self._parameters, self._returns, self.symbol)

    @functools.cached_property
    def _numba_type_(self) -> Any:
        """As numba asks for it."""
        if self._takes_arrays:
            return bitcode.callee_type(self._function)
        return bitcode.external_type(self.symbol, self._parameters, self._returns)


def entry(*parameters: Parameter) -> Callable[[Callable[..., N]], Entry[N]]:
    """Decorator: one parameter per argument, `int`, `float`, `array(...)` or the dtype of a
    record. The function's annotation says whether it returns `int` or `float`."""

    def decorate(function: Callable[..., N]) -> Entry[N]:
        return Entry(function, parameters)

    return decorate


def address(record: np.ndarray[Any, Any]) -> ctypes.c_void_p:
    """Of a record, for calls of an `Entry`; the record must outlive it."""
    return ctypes.c_void_p(record.ctypes.data)


_NUMBERS: dict[str, type[Any]] = {"int": int, "float": float}
_C_TYPES: dict[Any, Any] = {int: ctypes.c_int64, float: ctypes.c_double}
_LAYOUTS: dict[Any, str] = {int: "q", float: "d"}


def _layout(parameter: Parameter) -> str:
    """Of a parameter in a block."""
    if isinstance(parameter, ArrayKind):
        return "Q" + "q" * parameter.dimensions
    return _LAYOUTS.get(parameter, "Q")


def _flattener(parameter: Parameter) -> Callable[[Any], tuple[Any, ...]]:
    if isinstance(parameter, ArrayKind):
        return parameter.flat
    if isinstance(parameter, np.dtype):
        return lambda place: (place.value,)
    return lambda number: (number,)
