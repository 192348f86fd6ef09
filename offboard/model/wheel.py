"""Compiles every entry of the program into the bitcode that a wheel carries.

    python -m offboard.model.wheel DIRECTORY

Run by the build of a wheel (`hatch_build.py`) and by nothing that flies.
"""

from __future__ import annotations

import importlib
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from offboard.model import shipped, sources
from offboard.model.kernel import Entry


def main(directory: Path) -> None:
    """Write the bitcode of all entries where `offboard.model.shipped` looks for it."""
    symbols = list(_entries())
    with ProcessPoolExecutor() as pool:
        shipped.write(directory, dict(zip(symbols, pool.map(_compiled, symbols), strict=True)))
    print(f"{len(symbols)} compiled functions in {directory}")


def _entries() -> dict[str, Entry[Any]]:
    """All of the program's, by symbol."""
    for name in sources.entry_modules():
        importlib.import_module(name)
    return {entry.symbol: entry for entry in Entry.defined()}


def _compiled(symbol: str) -> bytes:
    return _entries()[symbol].bitcode()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
