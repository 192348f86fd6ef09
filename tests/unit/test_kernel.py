"""Machine code kept on disk: what it computes, who loads it, and what is never loaded."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from offboard.estimation.filtering import FILTER
from offboard.estimation.observer_adaptation import note
from offboard.model.kernel import array

ROOT = Path(__file__).parents[2]
ENTRIES = """
import numpy as np
from offboard.model.kernel import Entry, array, entry, kernel

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


@entry(array(2), array(1, "i8"), float)
def weigh(values, places, scale) -> float:
    total = 0.0
    for i in range(values.shape[0]):
        for k in range(values.shape[1]):
            total += scale * values[i, k] * places[k]
    places[0] = values.shape[0]
    return total


@entry(int, RECORD)
def add_twice(times, record):
    return add(times, record) + add(times, record)
"""
PROGRAM = """
import sys
import numpy as np
from pathlib import Path
from entries import RECORD, Entry, add, add_twice, weigh
from offboard.model import shipped
from offboard.model.kernel import address

if sys.argv[1]:
    shipped.DIRECTORY = Path(sys.argv[1])
compile_here, compiled_here = Entry.bitcode, []
Entry.bitcode = lambda entry: compiled_here.append(entry.symbol) or compile_here(entry)
ready = Entry.all_compiled()
Entry.compile_all()
record = np.zeros(1, RECORD)
record["values"] = (1.0, 2.0, 4.0)
answers = [each.call(times, address(record)) for each, times in ((add_twice, 1), (add, 2))]
places = np.array([1, 10])
values = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
answers.append(weigh.call(values, places, 0.5))
weighed, added = weigh.bound(values[:2].copy(), places, 2.0), add.bound(3, record)
places[:] = 10, 1
answers += [weighed(), added()]
print(ready, compiled_here, "numba" in sys.modules)
print(answers, places, float(record["total"][0]), int(record["calls"][0]))
"""
SHIP = """
import sys
from pathlib import Path
from entries import Entry
from offboard.model import shipped

shipped.write(Path(sys.argv[1]), {entry.symbol: entry.bitcode() for entry in Entry.defined()})
"""
COMPILED = "False ['entries.add', 'entries.weigh'] True"  # and the other one in another process
LOADED = "True [] False"
COMPUTED = "[20, 20, 64.5, 92.0, 30] [2 1] 24.5 4"


def _python(program: str, cache: Path, bitcode: Path | str = "", **settings: str) -> str:
    """What a program says that compiles for itself alone."""
    (cache / "entries.py").write_text(ENTRIES)
    ours = {"XDG_CACHE_HOME": str(cache), "TMPDIR": str(cache)}
    done = subprocess.run(
        [sys.executable, "-c", program, str(bitcode)],
        cwd=ROOT,
        env={**os.environ, **ours, **settings} | {"PYTHONPATH": f"{ROOT}{os.pathsep}{cache}"},
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    return done.stdout


def _run(cache: Path, bitcode: Path | str = "") -> str:
    """Where the machine code came from of a process that has computed what it should."""
    origin, computed = _python(PROGRAM, cache, bitcode).splitlines()
    assert computed == COMPUTED
    return origin


def test_machine_code_is_compiled_once_and_loaded_without_numba(tmp_path: Path) -> None:
    assert _run(tmp_path) == COMPILED
    assert _run(tmp_path) == LOADED
    kept, other, another = sorted(tmp_path.rglob("*.o"))
    for damaged in (kept, another):
        content = bytearray(damaged.read_bytes())
        content[len(content) // 2] ^= 1
        damaged.write_bytes(content)
    other.write_bytes(other.read_bytes()[:100])
    assert _run(tmp_path) == COMPILED
    assert _run(tmp_path) == LOADED
    kept.parent.chmod(0o777)
    assert _run(tmp_path) == COMPILED


def test_bitcode_that_came_with_the_package_needs_no_compiler(tmp_path: Path) -> None:
    """Compiled for any processor of this kind, it computes the same on this one."""
    bitcode = tmp_path / "bitcode"
    (tmp_path / "builder").mkdir()
    _python(SHIP, tmp_path / "builder", bitcode, NUMBA_CPU_NAME="generic")
    assert len(list(bitcode.rglob("*.bc"))) == 3
    (tmp_path / "user").mkdir()
    assert _run(tmp_path / "user", bitcode) == LOADED
    assert len(list(tmp_path.rglob("user/**/*.o"))) == 3
    assert _run(tmp_path / "user") == LOADED


def test_what_would_be_misread_is_refused() -> None:
    values = array(2).flat
    assert values(np.zeros((2, 3)))[1:] == (2, 3)
    fixed = np.ones((2, 3))
    fixed.flags.writeable = False
    assert values(fixed) == (fixed.ctypes.data, 2, 3)
    assert values(np.zeros((0, 3)))[1:] == (0, 3)
    with pytest.raises(TypeError, match="note is a record of another kind"):
        note.bound(np.zeros(1, FILTER), 0.0)
    for wrong in (np.zeros((2, 3))[:, ::2], np.zeros(3), np.zeros((2, 3), "f4")):
        with pytest.raises(TypeError, match="contiguous array of 2 dimensions of float64"):
            values(wrong)
