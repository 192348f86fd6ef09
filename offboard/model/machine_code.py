"""Machine code of compiled functions: made from LLVM's bitcode, kept in files, loaded again.

An object file is only ever loaded if this program wrote it, for these sources, compilers and this
processor, and if it is whole. Knows LLVM and files, and nothing of numba.
"""

from __future__ import annotations

import functools
import hashlib
import os
import tempfile
from importlib import metadata
from pathlib import Path
from typing import Any, cast

from offboard.model import cache, sources

_NOWHERE = 1  # an address


def emitted(bitcode: bytes) -> bytes:
    """An object file of this bitcode, made for the processor that is there."""
    import llvmlite.binding as llvm

    module = llvm.parse_bitcode(bitcode)
    machine = _machine()
    options = llvm.create_pipeline_tuning_options(speed_level=3)
    for vectorises in (True, False):  # the second round finds more: all is inlined by then
        options.loop_vectorization = vectorises
        builder = llvm.create_pass_builder(machine, options)
        builder.getModulePassManager().run(module, builder)
    return cast(bytes, machine.emit_object(module))


def _file(symbol: str) -> Path:
    return cache.directory() / f"{symbol}-{_identity()}.o"


@functools.cache
def _identity() -> str:
    """Of these sources, compilers and this processor: machine code of others is not for us."""
    import llvmlite.binding as llvm

    identity = (
        sources.digest(),
        metadata.version("numba"),
        metadata.version("llvmlite"),
        llvm.get_process_triple(),
        llvm.get_host_cpu_name(),
        llvm.get_host_cpu_features().flatten(),
    )
    return hashlib.sha256("\0".join(identity).encode()).hexdigest()[:16]


def kept(symbol: str) -> bytes | None:
    """The machine code in a file of ours; None when there is none, or it is damaged."""
    try:
        content = _file(symbol).read_bytes()
    except OSError:
        return None
    seal, code = content[:32], content[32:]
    return code if hashlib.sha256(code).digest() == seal else None


def keep(symbol: str, code: bytes) -> None:
    """Whole or not at all; without it the next start compiles again."""
    try:
        path = _file(symbol)
        handle, name = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(hashlib.sha256(code).digest() + code)
        os.replace(name, path)
    except OSError:
        pass


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


def load(symbol: str, code: bytes) -> int:
    """Address of the function in its machine code; what is loaded later may call it by name."""
    import llvmlite.binding as llvm

    engine = _engine()
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    place = int(engine.get_function_address(symbol))
    llvm.add_symbol(symbol, place)
    return place


def names(code: bytes, symbol: str) -> bool:
    """Whether this machine code calls `symbol`: an object file holds the names of what it wants."""
    return f"{symbol}\0".encode() in code


def pretend(symbol: str) -> None:
    """Have it found by what is compiled here and not called."""
    import llvmlite.binding as llvm

    llvm.add_symbol(symbol, _NOWHERE)
