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
import hashlib
import os
import re
import tempfile
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any, ClassVar, Generic, ParamSpec, TypeVar, cast

import numpy as np

from offboard.model.compilation import (
    is_private,
    prepare_cache,
    sources_digest,
    without_garbage_collection,
)

P = ParamSpec("P")
R = TypeVar("R")

# Numba's and Python's runtime: left over from errors that cannot happen here
_RUNTIME = ("NRT_", "Py", "_Py", "numba_")
_DECLARATION = re.compile(r"^declare (?P<head>[^@\n]*)@(?P<name>[\w.]+)\((?P<rest>.*)$", re.M)


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
        self._before = tuple(Entry._defined)
        Entry._defined.append(self)
        self.symbol = f"{function.__module__}.{function.__name__}"

    def __call__(self, *args: Any) -> int:
        """What the machine code does, as Python."""
        return self._function(*args)

    @functools.cached_property
    def call(self) -> Callable[..., int]:
        """The machine code as a function; compiled, or read from the cache, when first asked."""
        *_, place = [entry._address for entry in (*self._before, self)]  # it may call the others
        kinds = (ctypes.c_int64 if p is int else ctypes.c_void_p for p in self._parameters)
        prototype = ctypes.CFUNCTYPE(ctypes.c_int64, *kinds)
        return cast(Callable[..., int], prototype(place))

    @classmethod
    def all_kept(cls) -> bool:
        """Whether the machine code of all entries so far need not be compiled."""
        return all(_read(_place(entry.symbol)) is not None for entry in cls._defined)

    @functools.cached_property
    def _address(self) -> int:
        path = _place(self.symbol)
        code = _read(path)
        if code is None:
            code = self._compiled()
            _write(path, code)
        return _load(code, self.symbol)

    @property
    def _numba_type_(self) -> Any:
        """As numba asks for it: to compiled code an entry is a function somewhere else."""
        from numba import from_dtype, types

        kinds = (types.int64 if p is int else from_dtype(p) for p in self._parameters)
        return types.ExternalFunction(self.symbol, types.int64(*kinds))

    @without_garbage_collection()
    def _compiled(self) -> bytes:
        import llvmlite.binding as llvm
        from numba import cfunc, types

        kinds = (types.int64 if p is int else types.voidptr for p in self._parameters)
        compiled = cfunc(types.int64(*kinds), error_model="numpy")(self._taking_addresses())
        module = llvm.parse_assembly(_self_contained(compiled.inspect_llvm()))
        for function in module.functions:
            if function.name == compiled.native_name:
                function.name = self.symbol
            elif not function.is_declaration:
                function.linkage = "internal"
        return cast(bytes, _machine().emit_object(module))

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


def _self_contained(assembly: str) -> str:
    """Without the parts of numba's runtime: what would raise or allocate stops the process."""

    def definition(found: re.Match[str]) -> str:
        name = found["name"]
        if not name.startswith(_RUNTIME):
            return found[0]
        rest = re.sub(r"\s*#\d+|\s*local_unnamed_addr", "", found["rest"])
        return (
            f"define internal {found['head']}@{name}({rest} {{\n"
            "  call void @llvm.trap()\n  unreachable\n}"
        )

    text = _DECLARATION.sub(definition, assembly)
    return text if "declare void @llvm.trap" in text else text + "\ndeclare void @llvm.trap()\n"


# -- the cache ---------------------------------------------------------------------------------


def _place(symbol: str) -> Path:
    return prepare_cache() / f"{symbol}-{_identity()}.o"


@functools.cache
def _identity() -> str:
    """Of these sources, compilers and this processor: machine code of others is not for us."""
    import llvmlite.binding as llvm

    identity = (
        sources_digest(),
        metadata.version("numba"),
        metadata.version("llvmlite"),
        llvm.get_process_triple(),
        llvm.get_host_cpu_name(),
        llvm.get_host_cpu_features().flatten(),
    )
    return hashlib.sha256("\0".join(identity).encode()).hexdigest()[:16]


def _read(path: Path) -> bytes | None:
    """The machine code in a file of ours; None when there is none, or it is damaged."""
    try:
        if not is_private(path.parent):
            return None
        content = path.read_bytes()
    except OSError:
        return None
    seal, code = content[:32], content[32:]
    return code if hashlib.sha256(code).digest() == seal else None


def _write(path: Path, code: bytes) -> None:
    """Whole or not at all; without it the next start compiles again."""
    try:
        handle, name = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(hashlib.sha256(code).digest() + code)
        os.replace(name, path)
    except OSError:
        pass


# -- the processor -----------------------------------------------------------------------------


def _machine() -> Any:
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=3,
        reloc="default",
        codemodel="jitdefault",
        jit=True,
    )


@functools.cache
def _engine() -> Any:
    import llvmlite.binding as llvm

    return llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())


def _load(code: bytes, symbol: str) -> int:
    """Address of a function in machine code."""
    import llvmlite.binding as llvm

    engine = _engine()
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    place = int(engine.get_function_address(symbol))
    llvm.add_symbol(symbol, place)
    return place
