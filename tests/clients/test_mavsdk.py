"""MAVSDK flies the simulator: all that a pilot does with it, two flights with one process."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from programs import LIMIT_S, vehicle

SESSION = Path(__file__).with_name("mavsdk_session.py")
# What a real PX4 1.16.1 gave in the same session, and how far the simulator may be off
STEPS: list[tuple[str, Any, float]] = [
    ("found", [], 0.0),
    ("healthy", [1, 16, 1], 0.0),
    ("parameters", [1.0, 0, 1.5, 5, 2.5], 1e-6),
    ("in the air", [], 0.0),
    ("mode", ["HOLD"], 0.0),
    ("took off", [2.1], 0.5),
    ("mode", ["OFFBOARD"], 0.0),
    ("attitude", [5.1], 1.0),
    ("velocity", [0.77], 0.35),
    ("position", [0.87, 1.99, -4.16], 0.5),
    ("mode", ["HOLD"], 0.0),
    ("mode", ["LAND"], 0.0),
    ("landed and disarmed", [], 0.0),
    ("mission", [2], 0.0),
    ("mode", ["MISSION"], 0.0),
    ("progress", [2, 2], 0.0),
    ("mode", ["RETURN_TO_LAUNCH"], 0.0),
    ("far end", [9.5], 1.5),
    ("landed and disarmed", [], 0.0),
]
SHORT = [*STEPS[:6], *STEPS[11:13]]


@pytest.mark.parametrize(
    ("options", "simulated", "steps"),
    [
        (["--short"], ["--speed", "3"], SHORT),
        pytest.param([], [], STEPS, marks=pytest.mark.slow),
    ],
    ids=["takes off and lands", "whole session"],
)
def test_mavsdk_session_runs_as_on_a_real_px4(
    options: list[str], simulated: list[str], steps: Any
) -> None:
    with vehicle(*simulated) as port:
        done = subprocess.run(
            (sys.executable, str(SESSION), f"udpin://127.0.0.1:{port}", *options),
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
        )
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert [row["step"] for row in rows] == [step for step, *_ in steps]
    for row, (step, values, off) in zip(rows, steps, strict=True):
        expected = values if off == 0.0 else pytest.approx(values, abs=off)
        assert row["values"] == expected, step
