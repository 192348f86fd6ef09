"""`offboard compare` interrupted: what flies lands, what landed is kept, the rest is named."""

from __future__ import annotations

import csv
import signal
import time
from pathlib import Path

from processes import Spawn

SEEDS = 12


def test_interrupted_it_keeps_what_landed(spawn: Spawn, tmp_path: Path) -> None:
    process = spawn(
        "offboard", "compare", "--controllers", "lqr", "--reference", "hover", "--scenario", "calm",
        "--seeds", SEEDS, "--workers", 2, "--set", "reference.duration_s=1", "--out", "x",
    )  # fmt: skip
    while process.poll() is None and not list(tmp_path.rglob("score.json")):
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    told, said = process.communicate(timeout=60)
    assert process.returncode == 4
    (row,) = csv.DictReader((tmp_path / "x" / "compare.csv").open(encoding="utf-8"))
    flights = int(row["flights"])
    assert (row["controller"], row["failed"]) == ("lqr", "0")
    assert 1 <= flights <= 4
    assert f"interrupted: {SEEDS - flights} of {SEEDS} flights missing" in said
    assert "not flown: hover, calm: lqr seed" in told
    assert "not flown" in (tmp_path / "x" / "compare.html").read_text(encoding="utf-8")
    assert len(list(tmp_path.rglob("score.json"))) == flights
