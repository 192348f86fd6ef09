"""The .tlog of a flight: what the usual tools read in it, and that it holds what was flown."""

from __future__ import annotations

from pathlib import Path

import pytest

from offboard.analysis import history, tlog
from offboard.report.flight import read
from offboard.run import configuration as config
from offboard.run.flight import Simulated, fly
from offboard.run.sitl import InMemorySimulator


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
