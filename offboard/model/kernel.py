"""Compiled functions for processes that must not pay for numba.

numba costs 100 MB and a third of a second of every start. A `Kernel` is a function that numba
compiles when somebody first calls it. An `Entry` is what a program without numba calls instead: its
machine code, with that of all the kernels in it, is compiled once, kept as an object file beside
numba's own cache and loaded by llvmlite alone. Entries take integers and records (one-element
structured arrays, by address) and return an integer; they allocate nothing and raise nothing.
Knows neither vehicle nor controller.

What compiles in seconds: a function is compiled once for each type of its arguments, and of an
array in a record the size is part of the type; handed on as `record.array[:]` it is not.
"""

from __future__ import annotations

import ctypes
import functools
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any, ClassVar, Generic, ParamSpec, TypeVar, cast

import numpy as np

from offboard.model import machine_code
from offboard.model.compilation import without_garbage_collection

P = ParamSpec("P")
R = TypeVar("R")

_COMPILE_ONE = """
import importlib, sys
from offboard.model.kernel import Entry

importlib.import_module(sys.argv[1])
Entry.compile_one(sys.argv[2])
"""


class Kernel(Generic[P, R]):
    """A function compiled by numba when first called from Python or from compiled code."""

    def __init__(self, function: Callable[P, R]) -> None:
        self.function = function
        functools.update_wrapper(self, function)

    @functools.cached_property
    def dispatcher(self) -> Any:
        import numba

        return numba.njit(cache=True, error_model="numpy")(self.function)

    @property
    def _numba_type_(self) -> Any:
        """As numba asks for it: to compiled code a kernel is a dispatcher, without the ways in from
        Python, which take a third of the time that it takes to compile."""
        return self._within._numba_type_

    @functools.cached_property
    def _within(self) -> Any:
        import numba

        bare: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
        return numba.njit(error_model="numpy", **bare)(self.function)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        return cast(R, self.dispatcher(*args, **kwargs))


kernel = Kernel
"""The decorator."""


class Entry:
    """A kernel in machine code, and in compiled code a function that is not compiled with it.

    Called from Python, by `call`, it takes integers and the addresses of records; called from a
    kernel, or from an entry defined later, integers and records.
    """

    _defined: ClassVar[list[Entry]] = []

    def __init__(self, function: Callable[..., int], parameters: tuple[Any, ...]) -> None:
        self._function = function
        self._parameters = parameters
        self._address: int | None = None
        self._before = tuple(Entry._defined)
        Entry._defined.append(self)
        self.symbol = f"{function.__module__}.{function.__name__}"

    def __call__(self, *args: Any) -> int:
        """What the machine code does, as Python."""
        return self._function(*args)

    @functools.cached_property
    def call(self) -> Callable[..., int]:
        """The machine code as a function; compiled, or read from the cache, when first asked."""
        *_, place = [entry._load() for entry in (*self._before, self)]  # it may call the others
        kinds = (ctypes.c_int64 if p is int else ctypes.c_void_p for p in self._parameters)
        prototype = ctypes.CFUNCTYPE(ctypes.c_int64, *kinds)
        return cast(Callable[..., int], prototype(place))

    @classmethod
    def all_kept(cls) -> bool:
        """Whether nothing of the entries defined so far has to be compiled."""
        return all(machine_code.kept(entry.symbol) is not None for entry in cls._defined)

    @classmethod
    def compile_all(cls) -> None:
        """Compile what is not kept; the last entry in another process, which halves the time."""
        if cls.all_kept():
            return
        *others, last = cls._defined
        command = (sys.executable, "-c", _COMPILE_ONE, last._function.__module__, last.symbol)
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
        for other in entry._before:
            machine_code.pretend(other.symbol)
        machine_code.keep(symbol, entry._compiled())

    def _load(self) -> int:
        """The address of the machine code in this process."""
        if self._address is None:
            code = machine_code.kept(self.symbol)
            if code is None:
                code = self._compiled()
                machine_code.keep(self.symbol, code)
            self._address = machine_code.load(self.symbol, code)
        return self._address

    @property
    def _numba_type_(self) -> Any:
        """As numba asks for it: to compiled code an entry is a function somewhere else."""
        from numba import from_dtype, types

        kinds = (types.int64 if p is int else from_dtype(p) for p in self._parameters)
        return types.ExternalFunction(self.symbol, types.int64(*kinds))

    @without_garbage_collection()
    def _compiled(self) -> bytes:
        from numba import cfunc, types

        kinds = (types.int64 if p is int else types.voidptr for p in self._parameters)
        compiled = cfunc(types.int64(*kinds), error_model="numpy")(self._taking_addresses())
        assembly = compiled.inspect_llvm()
        return machine_code.assemble(assembly, compiled.native_name, self.symbol)

    def _taking_addresses(self) -> Callable[..., int]:
        """The function with records by address, written out, as numba wants its arguments."""
        import numba

        names = [f"a{i}" for i in range(len(self._parameters))]
        scope: dict[str, Any] = {
            "function": kernel(self._function),
            "carray": vars(numba)["carray"],
        }
        given = []
        for name, parameter in zip(names, self._parameters, strict=True):
            scope[f"{name}_record"] = parameter
            given.append(name if parameter is int else f"carray({name}, 1, {name}_record)[0]")
        listed = ", ".join(names)
        exec(f"def entry({listed}):\n    return function({', '.join(given)})", scope)
        return cast(Callable[..., int], scope["entry"])


def entry(*parameters: Any) -> Callable[[Callable[..., int]], Entry]:
    """Decorator: `parameters` are `int` or the dtype of a record, one per argument."""
    return lambda function: Entry(function, parameters)


def address(record: np.ndarray[Any, Any]) -> ctypes.c_void_p:
    """Of a record, for calls of an `Entry`; the record must outlive it."""
    return ctypes.c_void_p(record.ctypes.data)
