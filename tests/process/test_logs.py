"""The .tlog of real flights over UDP: reproducible bytes, and what the usual tools read in it."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from processes import Spawn

from offboard.analysis import history, tlog
from offboard.run import configuration as config

SHORT = ("--reference", "hover", "--set", "reference.duration_s=1", "--set", "reference.height_m=1")
SCRIPTS = Path(sys.executable).parent


def setpoints(directory: Path) -> list[bytes]:
    """Payload of every SET_ATTITUDE_TARGET."""
    log = tlog.read(directory / "flight.tlog")
    return [
        bytes(entry.message.get_payload()) for entry in log if entry.name == "SET_ATTITUDE_TARGET"
    ]


def test_same_seed_same_bytes_another_seed_others(spawn: Spawn, tmp_path: Path) -> None:
    seeds = {"one": 7, "two": 7, "three": 8}
    flights = [
        spawn("offboard", "fly", "--sitl", "--seed", seed, "--out", name, *SHORT)
        for name, seed in seeds.items()
    ]
    for flight in flights:
        _, errors = flight.communicate(timeout=60)
        assert (flight.returncode, errors) == (0, "")
    one, two, three = (setpoints(tmp_path / name) for name in seeds)
    assert len(one) > 80
    assert one == two
    assert one != three


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of one bundled flight of the table below."""
    directory = tmp_path_factory.mktemp("logs")
    rows = "".join(f"{t},{0.5 * t},0,-3\n" for t in range(9))
    (directory / "line.csv").write_text("time_s,north_m,east_m,down_m\n" + rows)
    subprocess.run(
        [SCRIPTS / "offboard", "fly", "--sitl", "--out", "x", "--reference", "line.csv"],
        cwd=directory, check=True, capture_output=True, timeout=60,
    )  # fmt: skip
    (directory / "line.csv").unlink()
    return directory / "x"


def tool(name: str, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, SCRIPTS / name, *arguments], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def scored(flight: Path) -> dict[str, object]:
    done = subprocess.run(
        [SCRIPTS / "offboard", "score", flight, "--json"], capture_output=True, timeout=60
    )
    assert done.returncode == 0
    document: dict[str, object] = json.loads(done.stdout)
    return document


def test_mavlogdump_counts_the_same_messages(flight: Path, scored: dict[str, object]) -> None:
    dumped = tool("mavlogdump.py", "--format", "standard", str(flight / "flight.tlog"))
    counted = Counter(re.findall(r"^\d{4}-\d\d-\d\d [\d:.]+: (\w+) \{", dumped, re.MULTILINE))
    assert counted == scored["messages"]


def test_mavflightmodes_shows_the_same_modes(flight: Path, scored: dict[str, object]) -> None:
    shown = tool("mavflightmodes.py", str(flight / "flight.tlog"))
    modes = re.findall(r"MAV\.flightmode=(\w+)", shown)
    ours = [str(mode["what"]).removeprefix("AUTO.") for mode in scored["modes"]]  # type: ignore
    assert modes == ours
    assert modes[:3] == ["LOITER", "OFFBOARD", "LAND"]


def test_mavloss_shows_no_loss(flight: Path) -> None:
    dialect = ("--dialect", "all")  # its default one lacks CURRENT_MODE
    shown = tool("mavloss.py", *dialect, str(flight / "flight.tlog"))
    assert re.search(r"Total: \d+ packets, 0 lost 0\.0%", shown)


def test_the_log_alone_holds_what_was_flown(flight: Path) -> None:
    """The table's file is gone, and the flight can still be planned again."""
    text = history.configuration(tlog.read(flight / "flight.tlog"))
    assert text is not None
    flown = config.flown(text)
    assert flown == config.load(str(flight / "flight.yaml"))
    assert flown.seed == 7
    track = config.build_track(flown)
    assert track.sample(track.track_start_s).position_ned_m[0] > 0.2
