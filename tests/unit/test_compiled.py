"""Compiled functions: what they compute, when they are compiled, and where machine code is kept."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from offboard.control.swarm import SEARCH, iterate
from offboard.estimation.motion import PLANT

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
from offboard.compiled import array, entry, kernel
from offboard.kernels import shifted

PAIR = np.dtype([("values", "f8", 2), ("calls", "i8")], align=True)


@entry(PAIR, int)
def add(pairs, times):
    pair = pairs[0]
    total = 0.0
    for _ in range(times):
        total += shifted(pair.values[0]) + shifted(pair.values[1])
    pair.calls += 1
    return total


@entry(array(2), array(1, "i8"), float)
def weigh(values, places, scale):
    total = 0.0
    for i in range(values.shape[0]):
        for k in range(values.shape[1]):
            total += scale * values[i, k] * places[k]
    places[0] = values.shape[0]
    return total
"""
CALL = """
import sys
import numpy as np
from offboard import compiled
from offboard.entries import PAIR, add, weigh

assert "numba" not in sys.modules
sentences = []
compiled.prepare(sentences.append)
pair, places = np.zeros(1, PAIR), np.array([1, 10])
pair["values"] = 3.0, 5.0
print(add(pair, 2), weigh(np.array([[1.0, 2.0], [3.0, 4.0]]), places, 0.5))
print(int(pair["calls"][0]), places.tolist(), len(sentences))
"""
DIRECTORY = "from offboard import compiled; print(compiled.directory())"


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package `offboard` with two entries, a kernel in another file and a constant in a third."""
    root = tmp_path / "package"
    (root / "offboard").mkdir(parents=True)
    shutil.copy(ROOT / "offboard" / "compiled.py", root / "offboard")
    sources = {"__init__": "", "constants": OFFSET, "kernels": KERNELS, "entries": ENTRIES}
    for name, source in (sources | {"other": ""}).items():
        (root / "offboard" / f"{name}.py").write_text(source)
    return root


def start(root: Path, code: str, **environment: str) -> subprocess.Popen[str]:
    clean = {key: value for key, value in os.environ.items() if "CACHE" not in key}
    return subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=root,
        env={**clean, "PYTHONPATH": str(root), **environment},
        stdout=subprocess.PIPE,
        text=True,
    )


def answer(root: Path, code: str, **environment: str) -> str:
    """What a new interpreter prints that has the package in `root`."""
    process = start(root, code, **environment)
    printed, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    return printed.strip()


def machine_code(cache: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in cache.rglob("*.nbc")}


def test_entries_are_compiled_once_and_loaded_by_the_next_process(
    package: Path, tmp_path: Path
) -> None:
    cache = str(tmp_path / "cache")
    assert answer(package, CALL, XDG_CACHE_HOME=cache) == "36.0 32.0\n1 [2, 10] 1"
    made = machine_code(tmp_path)
    assert len(made) == 2
    assert answer(package, CALL, XDG_CACHE_HOME=cache) == "36.0 32.0\n1 [2, 10] 0"
    assert machine_code(tmp_path) == made


def test_a_change_in_another_file_is_compiled(package: Path, tmp_path: Path) -> None:
    cache = str(tmp_path / "cache")
    assert answer(package, CALL, XDG_CACHE_HOME=cache).startswith("36.0 ")
    for changed, source, sum_of_both in (
        ("kernels", KERNELS.replace("2.0", "3.0"), "52.0"),
        ("constants", "OFFSET = 2.0\n", "56.0"),
    ):
        (package / "offboard" / f"{changed}.py").write_text(source)
        assert answer(package, CALL, XDG_CACHE_HOME=cache).startswith(f"{sum_of_both} ")


def test_without_compilation_the_same_functions_run_as_python(
    package: Path, tmp_path: Path
) -> None:
    cache = str(tmp_path / "cache")
    assert answer(package, CALL, XDG_CACHE_HOME=cache, NUMBA_DISABLE_JIT="1").startswith(
        "36.0 32.0\n1 [2, 10] "
    )
    assert not machine_code(tmp_path)


def test_the_directory_is_named_after_compiled_sources(tmp_path: Path) -> None:
    ignored = shutil.ignore_patterns("__pycache__")
    for name in ("offboard", "simulator"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=ignored)
    cache = {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    before = answer(tmp_path, DIRECTORY, **cache)
    for changed, renames in (
        ("offboard/documents/reading.py", False),
        ("offboard/flight/flight.py", False),
        ("offboard/model/rigid_body.py", True),
        ("offboard/model/state.py", True),  # the sizes of states
        ("simulator/steps.py", True),  # the length of a step
    ):
        with (tmp_path / changed).open("a") as source:
            source.write("\n# changed\n")
        after = answer(tmp_path, DIRECTORY, **cache)
        assert (after != before) is renames, changed
        before = after


def test_the_directory_is_below_the_first_usable_one(package: Path, tmp_path: Path) -> None:
    first, second, home = (tmp_path / name for name in ("numba", "xdg", "home"))
    given = {"NUMBA_CACHE_DIR": str(first), "XDG_CACHE_HOME": str(second), "HOME": str(home)}
    for place in (first, second, home / ".cache"):
        found = Path(answer(package, DIRECTORY, **given))
        assert found.parent == place / "pso-offboard"
        shutil.rmtree(place)
        place.parent.mkdir(exist_ok=True)
        place.write_text("not a directory")
    assert answer(package, CALL, **given).startswith("36.0 32.0\n")


def test_a_relative_directory_is_not_used(package: Path, tmp_path: Path) -> None:
    home = {"HOME": str(tmp_path / "home"), "XDG_CACHE_HOME": "here"}
    assert Path(answer(package, DIRECTORY, **home)).parent == tmp_path / "home/.cache/pso-offboard"
    assert not list(package.rglob("here"))


@pytest.mark.parametrize(
    "wrong",
    [
        np.zeros((3, 2, 8))[..., ::2],
        np.zeros(3),
        np.zeros((3, 2, 4), "f4"),
        np.zeros((4, 2, 3)).T,
    ],
    ids=["strided", "one dimension", "single precision", "transposed"],
)
def test_arguments_of_other_types_are_refused(wrong: np.ndarray) -> None:
    bounds, best, rng = np.zeros((2, 2)), np.ones(2), np.random.default_rng(0)
    with pytest.raises(TypeError, match="No matching definition"):
        iterate(np.zeros(1, SEARCH), rng, bounds, wrong, best, bounds)
    with pytest.raises(TypeError, match="No matching definition"):
        iterate(np.zeros(1, PLANT), rng, bounds, np.zeros((3, 2, 4)), best, bounds)


def test_importing_a_flight_does_not_import_numba() -> None:
    code = "import sys, offboard.run.flight, simulator.run; print('numba' in sys.modules)"
    assert answer(ROOT, code) == "False"
