"""The .tlog of a flight: what the usual tools read in it, and that it holds what was flown."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from offboard.analysis import history, tlog
from offboard.cli.commands import app
from offboard.report.flight import read
from offboard.run import configuration as config
from offboard.run.flight import Simulated, fly
from offboard.run.sitl import InMemorySimulator

SCRIPTS = Path(sys.executable).parent
ALL = ("--dialect", "all")  # the default one of this tool lacks CURRENT_MODE


def tool(name: str, *arguments: str) -> str:
    command = [sys.executable, SCRIPTS / name, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of one flight along the table below, whose file is gone."""
    directory = tmp_path_factory.mktemp("logs")
    rows = "".join(f"{t},{0.5 * t},0,-1\n" for t in range(9))
    (directory / "line.csv").write_text("time_s,north_m,east_m,down_m\n" + rows)
    line = {"controller": "lqr", "reference": str(directory / "line.csv")}
    flown = config.load("flight", choices=line, seed=7)
    assert fly(flown, directory / "x", Simulated(), simulator=InMemorySimulator()).exit_code == 0
    (directory / "line.csv").unlink()
    return directory / "x"


@pytest.fixture(scope="module")
def scored(flight: Path) -> dict[str, Any]:
    result = CliRunner().invoke(app, ["score", str(flight), "--json"])
    assert result.exit_code == 0, result.output
    return dict(json.loads(result.stdout))


def test_mavlogdump_counts_the_same_messages(flight: Path, scored: dict[str, Any]) -> None:
    dumped = tool("mavlogdump.py", *ALL, "--format", "standard", str(flight / "flight.tlog"))
    counted = Counter(re.findall(r"^\d{4}-\d\d-\d\d [\d:.]+: (\w+) \{", dumped, re.MULTILINE))
    assert counted == scored["messages"]


def test_mavflightmodes_shows_the_same_modes(flight: Path, scored: dict[str, Any]) -> None:
    shown = tool("mavflightmodes.py", str(flight / "flight.tlog"))
    modes = re.findall(r"MAV\.flightmode=(\w+)", shown)
    ours = [str(mode["what"]).removeprefix("AUTO.") for mode in scored["modes"]]
    assert modes == ours
    assert modes[:3] == ["LOITER", "OFFBOARD", "LAND"]


def test_the_log_alone_holds_what_was_flown(flight: Path) -> None:
    text = history.configuration(tlog.read(flight / "flight.tlog"))
    assert text is not None
    flown = config.flown(text)
    assert flown == config.load(str(flight / "flight.yaml"))
    assert flown.seed == 7
    track = config.build_track(flown)
    assert track.sample(track.track_start_s).position_ned_m[0] > 0.2
    facts = read(flight).facts  # the report names the table by its file
    assert (facts["reference"], facts["controller"]) == (str(flight.parent / "line.csv"), "lqr")
