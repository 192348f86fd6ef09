"""Machine code of compiled functions: made from LLVM's assembly, kept in files, loaded again.

An object file is only ever loaded if this program wrote it, for these sources, compilers and this
processor, and if it is whole. Knows LLVM and files; nothing of numba but the names of its runtime.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
import tempfile
from importlib import metadata
from pathlib import Path
from typing import Any, cast

from offboard.model.compilation import prepare_cache, sources_digest

# Numba's and Python's runtime: left over from errors that cannot happen here
_RUNTIME = ("NRT_", "Py", "_Py", "numba_")
_NOWHERE = 1  # an address
_DECLARATION = re.compile(r"^declare (?P<head>[^@\n]*)@(?P<name>[\w.]+)\((?P<rest>.*)$", re.M)


def assemble(assembly: str, name: str, symbol: str) -> bytes:
    """An object file in which the function `name` of this assembly is `symbol`, and nothing else
    is to be seen."""
    import llvmlite.binding as llvm

    module = llvm.parse_assembly(_self_contained(assembly))
    for function in module.functions:
        if function.name == name:
            function.name = symbol
        elif not function.is_declaration:
            function.linkage = "internal"
    return cast(bytes, _machine().emit_object(module))


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


def _file(symbol: str) -> Path:
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
    path = _file(symbol)
    try:
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


def pretend(symbol: str) -> None:
    """Have it found by what is compiled here and not called."""
    import llvmlite.binding as llvm

    llvm.add_symbol(symbol, _NOWHERE)
