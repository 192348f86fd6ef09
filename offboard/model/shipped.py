"""Bitcode of the compiled functions that came with the package, so that nothing has to be compiled.

A wheel carries it (`hatch_build.py`). A source tree, a changed source, and another kind of
processor or system than the wheel was built on have none: numba compiles there.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path

from offboard.model import sources

DIRECTORY = Path(__file__).resolve().parents[1] / "_bitcode"


def read(symbol: str) -> bytes | None:
    """What came with the package for these sources and this kind of processor, if anything."""
    try:
        return _file(DIRECTORY, symbol).read_bytes()
    except OSError:
        return None


def write(directory: Path, codes: Mapping[str, bytes]) -> None:
    """Put bitcode by symbol where `read` finds it once `directory` is in the package."""
    for symbol, code in codes.items():
        file = _file(directory, symbol)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(code)


def _file(directory: Path, symbol: str) -> Path:
    return directory / _kind() / f"{symbol}.bc"


@functools.cache
def _kind() -> str:
    """Of bitcode: for these sources, this kind of processor and system, and LLVM."""
    import llvmlite.binding as llvm

    return f"{sources.digest()}-{llvm.get_process_triple()}-llvm{llvm.llvm_version_info[0]}"
