"""Background writer and log: failing disks stop no caller, and what is lost is counted."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from offboard.link import log as log_module
from offboard.link.background import BackgroundWriter
from offboard.link.log import FlightLog

UNIX_US = 1_767_225_600_000_000
LONG_S = 20.0


class Disk:
    """Takes nothing until it is `free`."""

    def __init__(self) -> None:
        self.free, self.asked = threading.Event(), threading.Event()
        self.items: list[int] = []

    def write(self, items: list[int]) -> None:
        self.asked.set()
        assert self.free.wait(LONG_S)
        self.items += items


def test_in_lockstep_it_waits_and_loses_nothing() -> None:
    disk = Disk()
    disk.free.set()
    writer = BackgroundWriter(disk.write, 100, waits=True)
    for number in range(2000):
        writer.put(number)
    writer.close(LONG_S)
    assert (disk.items, writer.dropped) == ([*range(2000)], 0)


def test_a_failure_is_kept_and_ends_the_writing() -> None:
    """Of a display: rich ends the program where nobody reads its pipe."""
    failure = SystemExit(1)

    def write(_: list[int]) -> None:
        raise failure

    writer = BackgroundWriter(write, 100)
    writer.put(0)
    writer.close(LONG_S)
    writer.put(1)
    assert (writer.error, writer.dropped) == (failure, 2)


def test_a_disk_that_never_answers_is_named_and_all_is_counted_as_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk()
    monkeypatch.setattr(log_module, "append", lambda descriptor, entries: disk.write([]))
    monkeypatch.setattr(log_module, "QUEUED_MAX", 100)
    monkeypatch.setattr(log_module, "CLOSE_S", 0.05)
    with FlightLog(tmp_path / "x", "", real_time=True) as log:
        for number in range(300):
            log.write(UNIX_US + number, b"x")
        assert log.problem == f"the log {log.path} cannot be written (the disk is too slow)"
    assert log.lost == 300
    disk.free.set()
