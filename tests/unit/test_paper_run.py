"""The run of `offboard paper`: what it refuses, what it writes, what it keeps when interrupted."""

from __future__ import annotations

import csv
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from offboard.documents.errors import UserError
from offboard.paper.study import horizon
from offboard.paper.study.options import FIGURES, TABLES, PaperOptions, check
from offboard.paper.study.run import Outcome, reproduce

ROOT = Path(__file__).parents[2]


def quietly(options: PaperOptions) -> Outcome:
    return reproduce(options, Console(file=io.StringIO()))


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"figures": ("3",)}, "there is no figure '3'; known are gap, 4, 5"),
        ({"tables": ("1",)}, "there is no table '1'; known are 2, 3, 4, errata"),
        ({"seeds": 0}, "seeds must be 1 .. 10000, not 0"),
        ({"workers": 0}, "workers must be 1 or more, not 0"),
        ({"initial_q": (1.0, 2.0)}, "the initial Q takes 1 or 12 weights, not 2"),
        ({"initial_q": (1.0,) * 11 + (-1.0,)}, "must be 0 or more, not -1"),
        ({"initial_q": (float("nan"),)}, "must be 0 or more, not nan"),
    ],
)
def test_bad_options_are_one_sentence(
    tmp_path: Path, changes: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(UserError) as caught:
        check(PaperOptions(tmp_path / "never", **changes))
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "never").exists()


def test_an_output_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(UserError, match="cannot be written"):
            check(PaperOptions(out))


def test_initial_q_reaches_the_first_configuration(tmp_path: Path) -> None:
    assert PaperOptions(tmp_path).first_settings.fitness == (1,) * 12
    assert PaperOptions(tmp_path, initial_q=(2.0,)).first_settings.fitness == (2.0,) * 12
    twelve = tuple(float(i) for i in range(12))
    assert PaperOptions(tmp_path, initial_q=twelve).first_settings.fitness == twelve


def test_names_pick_pieces_and_nothing_else(tmp_path: Path) -> None:
    everything = PaperOptions(tmp_path)
    wanted = [f"table {name}" for name in TABLES] + [f"figure {name}" for name in FIGURES]
    assert list(everything.labels) == wanted
    outcome = quietly(PaperOptions(tmp_path, figures=("5",), tables=("bd",), workers=1))
    assert outcome.finished == ["table bd", "figure 5"]
    assert not outcome.missing
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"table_bd.csv", "table_bd.json", "figure_5.json", "paper.html", "run.json"}


def test_csv_and_json_say_the_same(tmp_path: Path) -> None:
    quietly(PaperOptions(tmp_path, tables=("horizon",), workers=1))
    rows = list(csv.DictReader((tmp_path / "table_horizon.csv").open(encoding="utf-8")))
    document = json.loads((tmp_path / "table_horizon.json").read_text(encoding="utf-8"))
    assert [row["law"] for row in rows] == [row["law"] for row in document["rows"]]
    assert float(rows[1]["time_constant_s"]) == document["rows"][1]["time_constant_s"]
    assert document["rows"][1]["time_constant_s"] == pytest.approx(39.16, rel=1e-3)


def test_processes_give_what_one_process_gives(tmp_path: Path) -> None:
    for workers in (1, 2):
        quietly(
            PaperOptions(
                tmp_path / str(workers), seeds=1, figures=("11",), tables=("4",), workers=workers
            )
        )
    for name in ("table_4.csv", "figure_11.json"):
        one, two = ((tmp_path / str(workers) / name).read_text() for workers in (1, 2))
        assert one == two


def test_an_interrupt_keeps_what_is_finished_and_names_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(horizon, "study", interrupted)
    outcome = quietly(PaperOptions(tmp_path, figures=("5",), tables=("horizon",), workers=1))
    assert outcome.interrupted
    assert outcome.finished == ["figure 5"]
    assert outcome.missing == {"table horizon": "interrupted before it was finished"}
    assert "table horizon: interrupted" in outcome.page.read_text(encoding="utf-8")
    assert json.loads((tmp_path / "run.json").read_text())["missing"] == outcome.missing


def test_a_piece_that_fails_fails_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_: object) -> None:
        raise ArithmeticError("no such mode")

    monkeypatch.setattr(horizon, "study", failing)
    outcome = quietly(PaperOptions(tmp_path, tables=("bd", "horizon"), workers=1))
    assert not outcome.interrupted
    assert outcome.finished == ["table bd"]
    assert outcome.missing == {"table horizon": "ArithmeticError: no such mode"}


SCRIPT = """
import sys
from pathlib import Path
from offboard.paper.study.options import PaperOptions
from offboard.paper.study.run import reproduce
if __name__ == "__main__":
    outcome = reproduce(PaperOptions(Path(sys.argv[1]), seeds=200, workers=2))
    sys.exit(7 if outcome.interrupted and outcome.missing else 0)
"""


def test_control_c_ends_a_parallel_run_in_order(tmp_path: Path) -> None:
    script, out = tmp_path / "long_run.py", tmp_path / "out"
    script.write_text(SCRIPT)
    process = subprocess.Popen(
        [sys.executable, str(script), str(out)], cwd=ROOT, stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT)}, start_new_session=True,
    )  # fmt: skip
    try:
        deadline = time.monotonic() + 60
        while not (out / "figure_5.json").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to every process
        _, errors = process.communicate(timeout=60)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 7, errors.decode()[-2000:]
    assert "Traceback" not in errors.decode()
    assert "Not on this page" in (out / "paper.html").read_text(encoding="utf-8")
