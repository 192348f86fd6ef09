"""Machine code kept on disk: what it computes, who loads it, and what is never loaded."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from offboard.model.kernel import kernel

ROOT = Path(__file__).parents[2]
ENTRIES = """
import numpy as np
from offboard.model.kernel import Entry, entry, kernel

RECORD = np.dtype([("values", "f8", 3), ("total", "f8"), ("calls", "i8")], align=True)


@kernel
def halved(value):
    return 0.5 * value


@entry(int, RECORD)
def add(times, record):
    for _ in range(times):
        for i in range(3):
            record.total += halved(record.values[i])
    record.calls += 1
    return 10 * times


@entry(int, RECORD)
def add_twice(times, record):
    return add(times, record) + add(times, record)
"""
PROGRAM = """
import sys
import numpy as np
from entries import RECORD, Entry, add, add_twice
from offboard.model.kernel import address

compile_here, compiled_here = Entry.bitcode, []
Entry.bitcode = lambda entry: compiled_here.append(entry.symbol) or compile_here(entry)
kept = Entry.all_compiled()
Entry.compile_all()
record = np.zeros(1, RECORD)
record["values"] = (1.0, 2.0, 4.0)
answers = [each.call(times, address(record)) for each, times in ((add_twice, 1), (add, 2))]
print(kept, compiled_here, "numba" in sys.modules)
print(answers, float(record["total"][0]), int(record["calls"][0]))
"""
COMPILED = "False ['entries.add'] True"  # and the other one in another process
LOADED = "True [] False"
COMPUTED = "[20, 20] 14.0 3"


def _run(cache: Path) -> str:
    """What a process says about where its machine code came from, once it has computed."""
    (cache / "entries.py").write_text(ENTRIES)
    clean = {key: value for key, value in os.environ.items() if not key.startswith("NUMBA")}
    ours = {"XDG_CACHE_HOME": str(cache), "TMPDIR": str(cache)}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=ROOT,
        env=clean | ours | {"PYTHONPATH": f"{ROOT}{os.pathsep}{cache}"},
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    origin, computed = done.stdout.splitlines()
    assert computed == COMPUTED
    return origin


def test_machine_code_is_compiled_once_and_loaded_without_numba(tmp_path: Path) -> None:
    assert _run(tmp_path) == COMPILED
    assert _run(tmp_path) == LOADED
    kept, other = sorted(tmp_path.rglob("*.o"))
    content = bytearray(kept.read_bytes())
    content[len(content) // 2] ^= 1
    kept.write_bytes(content)
    other.write_bytes(other.read_bytes()[:100])
    assert _run(tmp_path) == COMPILED
    assert _run(tmp_path) == LOADED
    kept.parent.chmod(0o777)
    assert _run(tmp_path) == COMPILED


def test_a_kernel_is_called_from_python_and_from_other_compiled_code() -> None:
    @kernel
    def squared(value: float) -> float:
        return value * value

    @kernel
    def norm(values: np.ndarray) -> float:
        total = 0.0
        for value in values:
            total += squared(value)
        return total**0.5

    assert norm(np.array([3.0, 4.0])) == pytest.approx(5.0)
    assert squared(1.5) == squared.function(1.5) == 2.25
