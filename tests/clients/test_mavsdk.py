"""MAVSDK flies the simulator in real time: everything a pilot does by it, twice on one process."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from vehicle_process import LIMIT_S, vehicle

SESSION = Path(__file__).with_name("mavsdk_session.py")
STEPS = [
    "found",
    "healthy",
    "parameters",
    "parameter list",
    "in the air",
    "mode HOLD",
    "took off",
    "mode OFFBOARD",
    "attitude",
    "rates",
    "velocity",
    "body velocity",
    "position",
    "global position",
    "mode HOLD",
    "mode LAND",
    "landed and disarmed",
    "mission",
    "mode MISSION",
    "progress",
    "mode RETURN_TO_LAUNCH",
    "far end",
    "landed and disarmed",
]


def flown(*options: str, simulated: tuple[str, ...] = ()) -> list[dict[str, Any]]:
    """The rows of one session with the default scenario."""
    with vehicle(*simulated) as port:
        done = subprocess.run(
            (sys.executable, str(SESSION), f"udpin://127.0.0.1:{port}", *options),
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
        )
    assert done.returncode == 0, done.stdout + done.stderr
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]


def named(row: dict[str, Any]) -> str:
    return f"mode {row['values'][0]}" if row["step"] == "mode" else row["step"]


def test_it_takes_off_and_lands() -> None:
    """Three times as fast as real time."""
    rows = flown("--short", simulated=("--speed", "3"))
    assert [named(row) for row in rows] == [*STEPS[:7], *STEPS[15:17]]


# What a real PX4 1.16.1 gave in the same session, and how far the simulator may be off.
ROWS = {
    "healthy": ([1, 16, 1], 0.0),
    "parameters": ([1.0, 0, 1.5, 5, 2.5], 1e-6),
    "took off": ([2.1], 0.5),
    "attitude": ([5.1], 1.0),
    "rates": ([39.6], 12.0),
    "velocity": ([0.77], 0.35),
    "body velocity": ([0.61], 0.35),
    "position": ([0.87, 1.99, -4.16], 0.5),
    "global position": ([3.14, -0.14, 3.67], 0.8),
    "mission": ([2], 0.0),
    "progress": ([2, 2], 0.0),
    "far end": ([9.5], 1.5),
}


@pytest.mark.slow
def test_the_vehicle_does_what_px4_did() -> None:
    session = flown()
    assert [named(row) for row in session] == STEPS
    for step, (values, off) in ROWS.items():
        (row,) = (row for row in session if row["step"] == step)
        assert row["values"] == pytest.approx(values, abs=off), step
