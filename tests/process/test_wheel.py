"""The wheel: what a user gets who has no source tree, where nothing was compiled before."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from processes import Spawn, free_port

ROOT = Path(__file__).parents[2]
BUILD = (sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory")
TEXT = {".py", ".yaml", ".csv", ".md", ".j2", ".txt", ".typed", ".html", ".css", ".js", ""}
HOVER = ("--reference", "hover", "--set", "reference.duration_s=2", "--set", "reference.height_m=1")
COMPILING = "first flight with this code: compiling"


@pytest.mark.slow
def test_installed_wheel_flies_over_udp_and_with_sitl(spawn: Spawn, tmp_path: Path) -> None:
    """The first flight, in real time, compiles everything; the second uses that machine code."""
    built = tmp_path / "dist"
    subprocess.run((*BUILD, built), cwd=ROOT, check=True, capture_output=True, timeout=60)
    (wheel,) = built.iterdir()
    assert wheel.name.endswith("-py3-none-any.whl")
    site, cache = tmp_path / "site", tmp_path / "cache"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
        assert {Path(name).suffix for name in archive.namelist()} <= TEXT
    places = {"PYTHONPATH": str(site), "XDG_CACHE_HOME": str(cache)}

    port = free_port()
    vehicle = ("--connect", f"udpout:127.0.0.1:{port}", "--gcs", "none")
    simulator = spawn("simulator", *vehicle, **places)
    connection = ("--connect", f"udpin:127.0.0.1:{port}", "--set", "limits.connect_s=120")
    flight = spawn("offboard", "fly", *connection, "--out", "x", *HOVER, **places)
    shown, errors = flight.communicate(timeout=150)
    assert (flight.returncode, errors) == (0, ""), shown
    assert COMPILING in shown
    assert simulator.poll() is None
    assert b"supervisor:" not in (tmp_path / "x" / "flight.tlog").read_bytes()
    score = json.loads((tmp_path / "x" / "score.json").read_text())
    # half of COM_OF_LOSS_T: 0.11 s on an idle machine; a shared one may stall both processes
    assert score["setpoint_gap_wall_max_s"] < 0.5
    assert score["setpoint_gap_max_s"] < 0.5
    assert score["tracked_s"] > 1.8
    assert score["rmse_position_m"] < 0.1
    simulator.kill()

    places["HOME"] = "/dev/null"  # no directory: nothing is said about it
    again = spawn("offboard", "fly", "--sitl", "--out", "y", *HOVER, **places)
    shown, errors = again.communicate(timeout=150)
    assert (again.returncode, errors) == (0, "")
    assert COMPILING not in shown
    assert json.loads((tmp_path / "y" / "score.json").read_text())["rmse_position_m"] < 0.05
    assert {path.name for path in tmp_path.iterdir()} == {
        *("dist", "site", "cache", "x", "y", "json.py", "pickle.py"),
    }
    assert not list(site.rglob("*.nbc"))
