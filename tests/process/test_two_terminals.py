"""`simulator` and `offboard fly` as two processes in real time, compiling everything first."""

from __future__ import annotations

import json
from pathlib import Path

from processes import Spawn

SHORT = ("--reference", "hover", "--set", "reference.duration_s=2", "--set", "reference.height_m=1")


def test_real_time_after_the_compilation_cache_was_deleted(
    spawn: Spawn, port: int, tmp_path: Path
) -> None:
    cache = {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    simulator = spawn(
        "simulator", "--connect", f"udpout:127.0.0.1:{port}", "--gcs", "none", **cache
    )
    flight = spawn(
        "offboard", "fly", "--connect", f"udpin:127.0.0.1:{port}", "--out", "x", *SHORT,
        "--set", "limits.connect_s=120", **cache,
    )  # fmt: skip
    shown, errors = flight.communicate(timeout=150)
    assert (flight.returncode, errors) == (0, ""), shown
    assert "first run on this machine: compiling" in shown
    assert simulator.poll() is None
    assert b"supervisor:" not in (tmp_path / "x" / "flight.tlog").read_bytes()
    score = json.loads((tmp_path / "x" / "score.json").read_text())
    # Half of PX4's COM_OF_LOSS_T: on an idle machine it is 0.11 s, a shared one may stall us both
    assert score["setpoint_gap_wall_max_s"] < 0.5
    assert score["setpoint_gap_max_s"] < 0.5
    assert score["tracked_s"] > 1.8
    assert score["rmse_position_m"] < 0.1
