"""LLVM bitcode of compiled functions, made by numba, which is imported nowhere else.

Bitcode is for any processor of a kind: `offboard.model.machine_code` makes the best of it on the
one that is there.
"""

from __future__ import annotations

import functools
import gc
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, cast

import numpy as np

# Numba's and Python's runtime: left over from errors that cannot happen here
_RUNTIME = ("NRT_", "Py", "_Py", "numba_")
_DECLARATION = re.compile(r"^declare (?P<head>[^@\n]*)@(?P<name>[\w.]+)\((?P<rest>.*)$", re.M)


def callee_type(function: Callable[..., Any]) -> Any:
    """The type by which numba compiles a function into its callers."""
    return _callee(function)._numba_type_


@functools.cache  # a type does not keep its function alive, and it is to be compiled once
def _callee(function: Callable[..., Any]) -> Any:
    """Without the ways in from Python, which take a third of the time that it takes to compile."""
    import numba

    bare: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return numba.njit(error_model="numpy", **bare)(function)


def external_type(symbol: str, parameters: tuple[Any, ...], returns: type) -> Any:
    """The type by which numba takes a function as machine code found elsewhere."""
    from numba import from_dtype, types

    numbers = {int: types.int64, float: types.float64}
    kinds = (numbers.get(each) or from_dtype(each) for each in parameters)
    return types.ExternalFunction(symbol, numbers[returns](*kinds))


def compiled(
    function: Callable[..., Any], parameters: tuple[Any, ...], returns: type, symbol: str
) -> bytes:
    """The function as `symbol`, and nothing else to be seen, compiled by numba.

    parameters: per argument `int`, `float`, the dtype of a record that comes by address, or what
    has `dimensions` and a `dtype`, an array. Where there are arrays, all arguments come in one
    block of 8 bytes each, given twice: a number, an address, and of arrays the lengths as well.
    """
    import llvmlite.binding as llvm
    from numba import cfunc, types

    numbers = {int: types.int64, float: types.float64}
    if any(hasattr(each, "dimensions") for each in parameters):
        kinds = [types.voidptr, vars(types)["CPointer"](types.voidptr)]
        taking = _taking_block(function, parameters)
    else:
        kinds = [numbers.get(each, types.voidptr) for each in parameters]
        taking = _taking_addresses(function, parameters)
    with _without_garbage_collection(), _not_optimised():
        made = cfunc(numbers[returns](*kinds), error_model="numpy")(taking)
        assembly = made.inspect_llvm()
    module = llvm.parse_assembly(_self_contained(assembly))
    for each in module.functions:
        if each.name == made.native_name:
            each.name = symbol
        elif not each.is_declaration:
            each.linkage = "internal"
    _tidy(module)
    return cast(bytes, module.as_bitcode())


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """numba makes so many objects that a tenth of its time goes there."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@contextmanager
def _not_optimised() -> Iterator[None]:
    """Have numba leave that to whoever knows the processor that flies: a loop that was turned round
    once is often not vectorised any more."""
    from numba import config

    options = vars(config)
    kept = {name: options[name] for name in ("OPT", "LOOP_VECTORIZE")}
    options.update(OPT=type(kept["OPT"])(0), LOOP_VECTORIZE=0)
    try:
        yield
    finally:
        options.update(kept)


def _tidy(module: Any) -> None:
    """A fifth of the size: variables in registers, and no instruction that does nothing."""
    import llvmlite.binding as llvm

    passes = llvm.create_new_function_pass_manager()
    passes.add_sroa_pass()
    passes.add_instruction_combine_pass()
    passes.add_simplify_cfg_pass()
    machine = llvm.Target.from_default_triple().create_target_machine()
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options())
    for function in module.functions:
        if not function.is_declaration:
            passes.run(function, builder)


def _taking_addresses(
    function: Callable[..., Any], parameters: tuple[Any, ...]
) -> Callable[..., Any]:
    """The function with addresses for records, written out, as numba wants its arguments."""
    names = [f"a{i}" for i in range(len(parameters))]
    given = [
        name if isinstance(each, type) else f"carray({name}, 1, {name}_dtype)[0]"
        for name, each in zip(names, parameters, strict=True)
    ]
    return _written(function, parameters, ", ".join(names), given)


def _taking_block(function: Callable[..., Any], parameters: tuple[Any, ...]) -> Callable[..., Any]:
    """The function with one block for its arguments."""
    given: list[str] = []
    place = 0
    for i, each in enumerate(parameters):
        count = getattr(each, "dimensions", 0)
        if isinstance(each, type):
            given.append(f"{each.__name__}s[{place}]")
        elif count:
            lengths = "".join(f"ints[{place + axis}], " for axis in range(1, count + 1))
            given.append(f"carray(places[{place}], ({lengths}), a{i}_dtype)")
        else:
            given.append(f"carray(places[{place}], 1, a{i}_dtype)[0]")
        place += 1 + count
    numbers = [f"{name}s = carray(block, {place}, {name}_dtype)" for name in ("int", "float")]
    return _written(function, parameters, "block, places", given, *numbers)


def _written(
    function: Callable[..., Any],
    parameters: tuple[Any, ...],
    taken: str,
    given: list[str],
    *before: str,
) -> Callable[..., Any]:
    import numba

    scope: dict[str, Any] = {"function": _callee(function), "carray": vars(numba)["carray"]}
    scope |= {"int_dtype": np.dtype("i8"), "float_dtype": np.dtype("f8")}
    scope |= {f"a{i}_dtype": getattr(each, "dtype", each) for i, each in enumerate(parameters)}
    lines = (*before, f"return function({', '.join(given)})")
    exec(f"def entry({taken}):\n    " + "\n    ".join(lines), scope)
    return cast(Callable[..., Any], scope["entry"])


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
