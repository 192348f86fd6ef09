"""The checks by name, their report, and what they say of this computer."""

from __future__ import annotations

import re
import threading
import time
from pathlib import Path

import pytest
from doctor_bench import bench
from processes import register

from offboard.doctor import computer, run
from offboard.doctor.listening import Listening, Observation
from offboard.flight.preflight import Level
from offboard.mavlink.session import SessionSettings
from offboard.run.configuration import load
from offboard.run.flight import Connection

README = Path(__file__).parents[2] / "offboard" / "doctor" / "README.md"


def test_checks_of_other_packages_are_rows_and_broken_ones_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The one that the README shows; one that cannot be imported; one named as one of ours."""
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    (tmp_path / "site_checks.py").write_text(code)
    checks = {"ceiling": "site_checks:ceiling", "gone": "no_such_module:check", "gps": "json:loads"}
    register(tmp_path, "site_checks", run.GROUP, **checks)
    monkeypatch.syspath_prepend(tmp_path)
    seen = bench().listen()
    rows = {row.check: row for row in run.examine(run.names(["ceiling", "gone", "gps"]), seen)}
    assert rows["ceiling"].findings[0].hint == "--set limits.ceiling_m=6"
    assert "ModuleNotFoundError" in rows["gone"].findings[0].found
    assert rows["gps"].level is Level.OK


def test_the_command_ends_in_time_although_nothing_of_it_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A link that does not open, and a look at the computer without end."""
    never = threading.Event()
    monkeypatch.setattr(run, "OPEN_S", 0.1)
    monkeypatch.setattr(run, "LOOK_S", 0.4)
    monkeypatch.setattr(run, "open_link", lambda connection: never.wait())
    monkeypatch.setattr(computer, "build", lambda config: never.wait())
    monkeypatch.setattr(computer, "_not_compiled", lambda: 0)
    began_s = time.monotonic()
    seen = run.observe(Connection("tcp:10.0.0.1:5760"), load("flight"), tmp_path)
    rows = {row.check: row for row in run.examine(["port", "computer"], seen)}
    assert time.monotonic() - began_s < 2.0
    assert "cannot be opened in 0.1 s" in rows["port"].findings[0].found
    assert rows["computer"].level is Level.WAIT


def test_what_is_wrong_with_this_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk, a slow decision, and late waking up."""
    monkeypatch.setattr(computer, "LEAST_FREE_BYTES", 10**18)
    monkeypatch.setattr(computer, "_not_compiled", lambda: 0)
    monkeypatch.setattr(computer, "rehearse", lambda prepared, keeps_deadline: 0.04)
    monkeypatch.setattr(computer, "_sleep", lambda: 0.03)
    heard = Listening(0.0, SessionSettings())
    seen = Observation(load("flight"), heard, "udpin:127.0.0.1:1", Path(), time.monotonic())
    rows = run.examine(["disk", "compiled", "computer"], seen)
    levels = {row.check: [finding.level for finding in row.findings] for row in rows}
    assert levels == {"disk": [Level.WARN], "compiled": [Level.OK], "computer": [Level.WARN] * 2}
    found = " ".join(finding.found for finding in rows[-1].findings)
    assert "a decision takes 40.0 ms of 50 ms" in found
    assert "wakes up at most 30.0 ms late" in found
