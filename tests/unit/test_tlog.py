"""A .tlog against pymavlink, message by message, its columns, and damage in it."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from pymavlink import mavutil

from offboard.analysis import history, tlog

RECORDINGS = Path(__file__).parents[1] / "wire" / "recordings"
PX4, ARDUCOPTER = (
    RECORDINGS / f"{name}.tlog" for name in ("px4-1.16.1-offboard", "arducopter-4.6.3-guided")
)


@cache
def recorded() -> tuple[bytes, tuple[tlog.LoggedMessage, ...], list[int]]:
    """The first 500 entries of PX4's log: bytes, messages, and where each begins and the last one
    ends."""
    messages = tuple(itertools.islice(tlog.read(PX4), 500))
    at = [0, *itertools.accumulate(8 + len(entry.frame.raw) for entry in messages)]
    return PX4.read_bytes()[: at[-1]], messages, at


@pytest.mark.parametrize("path", [PX4, ARDUCOPTER])
def test_the_layout_of_every_message_is_pymavlinks(path: Path) -> None:
    """Of the first five messages of each name."""
    seen: Counter[str] = Counter()
    for entry in tlog.read(path):
        seen[entry.name] += 1
        if entry.name.startswith("UNKNOWN") or seen[entry.name] > 5:
            continue
        message, kind = entry.message, tlog.layout(entry.name)
        payload = entry.frame.payload[: kind.itemsize].ljust(kind.itemsize, b"\0")
        (row,) = np.frombuffer(payload, kind)
        for field in message.get_fieldnames():
            if not isinstance(expected := getattr(message, field), str):
                assert np.array_equal(row[field], expected, equal_nan=True), (entry.name, field)
    assert len(seen) > 20


def damaged(path: Path, data: bytes) -> tlog.Tlog:
    path.write_bytes(data)
    return tlog.read(path)


@pytest.mark.parametrize(
    ("offset", "byte"),
    [
        (8 + 12, 0x40),  # payload
        (0, 0x7F),  # time stamp
        (8, 0x55),  # first byte of the frame
        (9, 0xFF),  # length: the frame seems to reach into the next entries
        (9, 0x01),
    ],
)
def test_a_damaged_entry_is_skipped_and_counted(offset: int, byte: int, tmp_path: Path) -> None:
    """The first entry, one in the middle, and the last but one."""
    data, messages, at = recorded()
    for number in (0, len(messages) // 2, len(messages) - 2):
        changed = bytearray(data)
        changed[at[number] + offset] ^= byte
        log = damaged(tmp_path / "x.tlog", bytes(changed))
        assert tuple(log) == (*messages[:number], *messages[number + 1 :])
        assert (log.damaged, log.first_damage, log.truncated) == (1, at[number], 0)
        assert log.damage.endswith(f"1 damaged entry was skipped, the first at byte {at[number]}")


def test_entries_after_garbage_and_holes_are_read(tmp_path: Path) -> None:
    """Garbage between entries, a hole that cuts two, and one that cuts the last: 4000 random bytes
    hold about 30 that could begin a frame."""
    data, messages, at = recorded()
    garbage = np.random.default_rng(3).bytes(4000)
    parts = data[: at[100]], garbage, data[at[100] : at[200] + 7], data[at[203] + 5 : -7]
    log = damaged(tmp_path / "x.tlog", b"".join(parts))
    assert tuple(log) == (*messages[:200], *messages[204:-1])
    assert (log.damaged, log.first_damage) == (2, at[100])
    assert log.truncated == at[-1] - at[-2] - 7
    assert "2 damaged entries were skipped" in log.damage


def test_damage_at_the_end_is_reported_and_a_cut_entry_is_none(tmp_path: Path) -> None:
    """Garbage behind the last entry, a last entry with a wrong checksum, and one that is cut."""
    data, messages, at = recorded()
    wrong = bytearray(data)
    wrong[-1] ^= 1
    for changed, kept, damage in ((data + bytes(5000), 0, at[-1]), (bytes(wrong), 1, at[-2])):
        log = damaged(tmp_path / "x.tlog", changed)
        assert tuple(log) == messages[: len(messages) - kept]
        assert (log.damaged, log.first_damage, log.truncated) == (1, damage, 0)
    log = damaged(tmp_path / "x.tlog", data[:-3])
    assert tuple(log) == messages[:-1]
    assert (log.damaged, log.truncated) == (0, at[-1] - at[-2] - 3)


def test_a_log_is_read_in_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An entry at the border of one is found, also behind garbage."""
    data, messages, _ = recorded()
    monkeypatch.setattr(tlog, "_BLOCK", 1000)
    for short in range(12):
        log = damaged(tmp_path / "x.tlog", bytes(1000 - short) + data)
        assert tuple(log) == messages


def test_a_story_is_told_in_vehicle_time() -> None:
    """Every text and refusal beside the newest telemetry that lies before it in the file; a text
    in chunks (STATUSTEXT.id) is whole once a chunk ends short of its 50 bytes."""
    flown = history.gather(tlog.read(PX4))
    theirs = mavutil.mavlogfile(str(PX4))
    now_s, begun, expected = math.nan, "", []
    while (message := theirs.recv_msg()) is not None:
        kind, ours = message.get_type(), message.get_srcComponent() in history.OUR_COMPONENTS
        if kind in ("LOCAL_POSITION_NED", "ATTITUDE_QUATERNION"):
            now_s = message.time_boot_ms / 1e3
        elif kind == "STATUSTEXT" and not ours:
            begun += message.text
            if message.id == 0 or len(message.text) < 50:
                expected.append((now_s, begun.rstrip("\t")))
                begun = ""
        elif kind == "COMMAND_ACK" and message.result not in (0, 5):
            expected.append((now_s, f"command {message.command} refused, result {message.result}"))
    assert len(expected) > 5
    assert [(sent.time_s, sent.what) for sent in flown.vehicle_messages] == expected
