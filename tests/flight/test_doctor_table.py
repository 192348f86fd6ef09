"""Checks by name, of other packages, and their report."""

from __future__ import annotations

import json
import re
import threading
import time
from pathlib import Path

import pytest
from doctor_bench import bench

from offboard.doctor import computer, link_checks, run
from offboard.doctor.observation import Observation
from offboard.doctor.table import CheckError, as_json, checks, examine, verdict, worst
from offboard.flight.preflight import Level
from offboard.run.configuration import load
from offboard.run.flight import Connection

README = Path(__file__).parents[2] / "offboard" / "doctor" / "README.md"


def documented(site: Path) -> None:
    """Install what the README shows, as metadata and a module."""
    text = README.read_text()
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    ((name, where),) = re.findall(r'^(\w+) = "([\w:]+)"$', text, re.MULTILINE)
    (site / f"{where.partition(':')[0]}.py").write_text(code)
    registered(site, "site", {name: where})


def registered(site: Path, package: str, points: dict[str, str]) -> None:
    metadata = site / f"{package}-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    lines = "".join(f"{name} = {where}\n" for name, where in points.items())
    (metadata / "entry_points.txt").write_text(f"[pso_offboard.checks]\n{lines}")


def test_documented_check_of_another_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    documented(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (check,) = checks(["ceiling"])
    assert check.summary == "Whether a flight stays below the roof of the site."
    (row,) = examine([check], Observation(config=load("flight")))
    assert row.level is Level.WARN
    mended = load("flight", assignments=[row.findings[0].hint.removeprefix("--set ")])
    (row,) = examine([check], Observation(config=mended))
    assert row.level is Level.OK


def test_broken_checks_of_other_packages_are_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = {"gone": "no_such_module:check", "odd": "json:loads", "gps": "json:loads"}
    registered(tmp_path, "broken", points)
    monkeypatch.syspath_prepend(tmp_path)
    rows = {row.check: row for row in examine(checks(), Observation())}
    assert "ModuleNotFoundError" in rows["gone"].findings[0].found
    assert "TypeError" in rows["odd"].findings[0].found
    assert "gps" not in rows  # the built-in one, which has nothing to say of nothing


def test_the_command_ends_in_time_although_nothing_of_it_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A link that does not open, and a look at the computer without end."""
    never = threading.Event()
    monkeypatch.setattr(run, "OPEN_S", 0.1)
    monkeypatch.setattr(run, "LOOK_S", 0.4)
    monkeypatch.setattr(run, "open_link", lambda connection: never.wait())
    monkeypatch.setattr(run, "measure", lambda *given, **named: never.wait())
    began_s = time.monotonic()
    seen = run.observe(Connection("tcp:10.0.0.1:5760"), load("flight"), tmp_path)
    assert time.monotonic() - began_s < 2.0
    rows = {row.check: row for row in examine(checks(["port", "computer"]), seen)}
    assert "cannot be opened in 0.1 s" in rows["port"].findings[0].found
    assert rows["computer"].level is Level.WAIT


def test_unknown_check() -> None:
    with pytest.raises(CheckError, match="no check named 'gsp'; known are port, vehicle, senders"):
        checks(["gps", "gsp"])


def test_report_as_json() -> None:
    patient = bench(parameters={"COM_OBL_RC_ACT": 0.0})
    seen = patient.listen()
    rows = examine(checks(["gps", "parameters"]), seen)
    assert worst(rows) is Level.WARN
    report = json.loads(as_json(rows, seen, verdict(rows, complete=True)))
    assert (report["level"], report["verdict"]) == (
        "warn", "ready to fly; warnings: COM_OBL_RC_ACT"
    )  # fmt: skip
    assert report["vehicle"] == {"autopilot": "px4", "system_id": 1}
    assert report["version"] == [1, 16, 1]
    assert [row["check"] for row in report["rows"]] == ["gps", "parameters"]
    (finding, good) = report["rows"][1]["findings"]
    assert finding["hint"] == "param set COM_OBL_RC_ACT 4"
    assert (finding["level"], good["level"]) == ("warn", "ok")


@pytest.mark.parametrize(
    ("surroundings", "hint"), [("WSL", "hostname -I"), ("container", "-p PORT:PORT/udp"), ("", "")]
)
def test_silence_behind_a_bridge(surroundings: str, hint: str) -> None:
    seen = Observation(connection="udpin:127.0.0.1:14540", surroundings=surroundings)
    (finding,) = link_checks.vehicle(seen)
    assert finding.level is Level.BLOCKS
    assert hint in finding.hint
    assert "--connect udpin:0.0.0.0" in finding.hint


@pytest.mark.parametrize(
    ("version", "marks", "found"),
    [
        ("Linux version 5.15.90.1-microsoft-standard-WSL2", False, "WSL"),
        ("Linux version 6.1.0", True, "container"),
        ("Linux version 6.1.0", False, ""),
    ],
)
def test_surroundings(
    version: str, marks: bool, found: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "version").write_text(version)
    mark = tmp_path / "containerenv"
    if marks:
        mark.touch()
    monkeypatch.setattr(computer, "PROC", tmp_path)
    monkeypatch.setattr(computer, "CONTAINER_MARKS", (str(mark),))
    assert computer.surroundings() == found
