"""Compiled functions: what they compute, when they are compiled, and where machine code is kept."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
OFFSET = "OFFSET = 1.0\n"
KERNELS = """
from offboard.compiled import kernel
from offboard.constants import OFFSET


@kernel
def shifted(value):
    return 2.0 * value + OFFSET
"""
ENTRIES = """
import numpy as np
from offboard.compiled import array, entry
from offboard.kernels import shifted

PAIR = np.dtype([("values", "f8", 2), ("calls", "i8")], align=True)


@entry(PAIR, array(2), array(1, "i8"), float, int)
def add(pairs, values, places, scale, times):
    pair = pairs[0]
    total = 0.0
    for _ in range(times):
        total += shifted(pair.values[0]) + shifted(pair.values[1])
    for i in range(values.shape[0]):
        for k in range(values.shape[1]):
            total += scale * values[i, k] * places[k]
    places[0] = values.shape[0]
    pair.calls += 1
    return total
"""
CALL = """
import sys
import numpy as np
from offboard import compiled
from offboard.entries import PAIR, add

assert "numba" not in sys.modules
sentences = []
compiled.prepare(sentences.append)
pair, places = np.zeros(1, PAIR), np.array([1, 10])
pair["values"] = 3.0, 5.0
print(add(pair, np.array([[1.0, 2.0], [3.0, 4.0]]), places, 0.5, 2))
print(int(pair["calls"][0]), places.tolist(), len(sentences))
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package `offboard` with an entry, a kernel in another file and a constant in a third."""
    root = tmp_path / "package"
    (root / "offboard").mkdir(parents=True)
    shutil.copy(ROOT / "offboard" / "compiled.py", root / "offboard")
    sources = {"__init__": "", "constants": OFFSET, "kernels": KERNELS, "entries": ENTRIES}
    for name, source in sources.items():
        (root / "offboard" / f"{name}.py").write_text(source)
    return root


def answer(root: Path, code: str = CALL, **environment: str) -> str:
    """What `code` prints in a new interpreter that imports the package from `root`."""
    clean = {key: value for key, value in os.environ.items() if "CACHE" not in key}
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=root,
        env={**clean, "PYTHONPATH": str(root), **environment},
        stdout=subprocess.PIPE,
        text=True,
        timeout=120,
        check=True,
    ).stdout.strip()


def machine_code(cache: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in cache.rglob("*.nbc")}


def test_functions_are_recompiled_when_an_imported_file_changes(
    package: Path, tmp_path: Path
) -> None:
    cache = tmp_path / "cache"
    given = {"XDG_CACHE_HOME": str(cache), "HOME": str(tmp_path / "home")}
    assert answer(package, **given) == "68.0\n1 [2, 10] 1"
    made = machine_code(cache / "pso-offboard")
    assert len(made) == 1
    (package / "offboard" / "plain.py").write_text("from offboard.compiled import prepare\n")
    assert answer(package, **given) == "68.0\n1 [2, 10] 0"
    assert machine_code(cache) == made
    (package / "offboard" / "constants.py").write_text("OFFSET = 2.0\n")
    assert answer(package, **given).startswith("72.0\n")


def test_functions_run_as_python_without_compilation(package: Path, tmp_path: Path) -> None:
    given = {"XDG_CACHE_HOME": str(tmp_path / "cache"), "NUMBA_DISABLE_JIT": "1"}
    assert answer(package, **given).startswith("68.0\n1 [2, 10] ")
    assert not machine_code(tmp_path)


def test_cache_directory_is_below_the_first_usable_one(package: Path, tmp_path: Path) -> None:
    """A relative path is not used, as the XDG standard demands."""
    code = "from offboard import compiled; print(compiled.directory())"
    first, second, home = (tmp_path / name for name in ("numba", "xdg", "home"))
    given = {"NUMBA_CACHE_DIR": str(first), "XDG_CACHE_HOME": str(second), "HOME": str(home)}
    for place in (first, second):
        assert Path(answer(package, code, **given)).parent == place / "pso-offboard"
        shutil.rmtree(place)
        place.write_text("not a directory")
    given["XDG_CACHE_HOME"] = "here"
    assert Path(answer(package, code, **given)).parent == home / ".cache/pso-offboard"
    assert not list(package.rglob("here"))
    nowhere = dict.fromkeys(given, str(first))  # a file, so that the temporary directory is used
    nowhere["TMPDIR"] = str(tmp_path)
    assert answer(package, **nowhere) == "68.0\n1 [2, 10] 1"
    assert answer(package, **nowhere) == "68.0\n1 [2, 10] 0"
    (kept,) = tmp_path.glob("pso-offboard-*")
    shutil.rmtree(kept)
    kept.symlink_to(home)  # a link is not followed to a directory of somebody else
    if os.getuid() == 0:
        os.chown(kept, 65534, 65534, follow_symlinks=False)
        assert Path(answer(package, code, **nowhere)) != kept


def test_importing_a_flight_does_not_import_numba() -> None:
    code = "import sys, offboard.run.flight, simulator.run; print('numba' in sys.modules)"
    assert answer(ROOT, code) == "False"
