"""Background writer and log: slow and failing disks stop no caller, and what is lost is counted."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from offboard.analysis import tlog
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


@pytest.mark.parametrize(
    ("room", "waits", "free", "put", "written"),
    [
        (1000, False, False, 500, 500),  # a slow disk stops nobody and loses nothing
        (10, False, False, 50, 10),  # what does not fit is dropped and counted
        (100, True, True, 2000, 2000),  # in lockstep it waits
    ],
)
def test_what_is_written_and_what_is_dropped(
    room: int, waits: bool, free: bool, put: int, written: int
) -> None:
    disk = Disk()
    if free:
        disk.free.set()
    writer = BackgroundWriter(disk.write, room, waits=waits)
    writer.put(-1)
    assert disk.asked.wait(LONG_S)  # holds the first
    for number in range(put):
        writer.put(number)
    assert free or disk.items == []
    assert writer.dropped == put - written
    disk.free.set()
    writer.close(LONG_S)
    assert disk.items == [-1, *range(written)]


def test_what_is_stuck_at_the_end_is_counted() -> None:
    disk = Disk()
    writer = BackgroundWriter(disk.write, 100)
    for number in range(8):
        writer.put(number)
    assert disk.asked.wait(LONG_S)
    writer.close(0.05)
    assert writer.dropped == 8
    assert not writer.is_free()
    disk.free.set()


@pytest.mark.parametrize("failure", [OSError(28, "No space left"), SystemExit(1)])
def test_a_failure_is_kept_and_ends_the_writing(failure: BaseException) -> None:
    written: list[int] = []

    def write(items: list[int]) -> None:
        if written:
            raise failure
        written.extend(items)

    writer = BackgroundWriter(write, 100)
    writer.put(0)
    while not written:
        pass
    for number in range(1, 6):
        writer.put(number)
    writer.close(LONG_S)
    assert (writer.error, writer.dropped, written) == (failure, 5, [0])


def test_a_log_on_a_slow_disk_is_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free, right = threading.Event(), log_module.append

    def slow(descriptor: int, entries: list[bytes]) -> None:
        assert free.wait(LONG_S)
        right(descriptor, entries)

    monkeypatch.setattr(log_module, "append", slow)
    beat, sender = mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), mavlink.MAVLink(None, 1, 1)
    frames = []
    for number in range(3000):
        sender.seq = number % 256
        frames.append(bytes(beat.pack(sender)))
    with FlightLog(tmp_path / "x", "", real_time=True) as log:
        for number, frame in enumerate(frames):
            log.write(UNIX_US + 100 * number, frame)
        assert log.path.stat().st_size == 0
        free.set()
    assert [entry.frame.raw for entry in tlog.read(log.path)] == frames
    assert (log.problem, log.lost) == ("", 0)


def test_a_disk_that_never_answers_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = threading.Event()
    monkeypatch.setattr(log_module, "append", lambda descriptor, entries: free.wait(LONG_S))
    monkeypatch.setattr(log_module, "QUEUED_MAX", 100)
    monkeypatch.setattr(log_module, "CLOSE_S", 0.05)
    with FlightLog(tmp_path / "x", "", real_time=True) as log:
        for number in range(300):
            log.write(UNIX_US + number, b"x")
        assert log.problem == f"the log {log.path} cannot be written (the disk is too slow)"
    assert log.lost == 300
    free.set()
