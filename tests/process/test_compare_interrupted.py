"""`offboard compare` interrupted: flights land, results are kept, missing flights are named."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import time
from pathlib import Path

from processes import SHORT, Spawn, children

SEEDS = 12
COMPARE = (
    "compare", "--controllers", "lqr", "--reference", "hover", "--scenario", "calm",
    "--seeds", SEEDS, "--workers", 2, "--out", "x", *SHORT,
)  # fmt: skip


def as_a_terminal_interrupts(process: subprocess.Popen[str]) -> tuple[str, str]:
    os.killpg(process.pid, signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 4
    assert "Traceback" not in errors
    return output, errors


def test_interrupted_it_keeps_what_landed(spawn: Spawn, tmp_path: Path) -> None:
    process = spawn("offboard", *COMPARE)
    while process.poll() is None and not list(tmp_path.rglob("score.json")):
        time.sleep(0.01)
    output, errors = as_a_terminal_interrupts(process)
    (row,) = csv.DictReader((tmp_path / "x" / "compare.csv").open(encoding="utf-8"))
    flights = int(row["flights"])
    assert (row["controller"], row["failed"]) == ("lqr", "0")
    assert 1 <= flights <= 4
    assert f"interrupted: {SEEDS - flights} of {SEEDS} flights missing" in errors
    assert "interrupted: flights in the air are finished" in output
    assert "not flown: hover, calm: lqr seed" in output
    assert "not flown" in (tmp_path / "x" / "compare.html").read_text(encoding="utf-8")
    kept = [path.parent for path in tmp_path.rglob("score.json")]
    assert len(kept) == flights
    assert all("duration_s: 1.0\n" in (each / "flight.yaml").read_text() for each in kept)


def test_interrupted_while_its_processes_load_it_ends_in_order(spawn: Spawn) -> None:
    process = spawn("offboard", *COMPARE)
    while process.poll() is None and len(children(process.pid)) < 3:  # a tracker, two of ours
        time.sleep(0.01)
    output, errors = as_a_terminal_interrupts(process)
    assert "the process that flew it ended" not in output
    assert "flights missing" in errors
