"""A .tlog read by columns against pymavlink, message by message, and with damage in it."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink import mavutil

from offboard.analysis import history, tlog

RECORDINGS = Path(__file__).parents[1] / "wire" / "recordings"
PX4, ARDUCOPTER = (
    RECORDINGS / f"{name}.tlog" for name in ("px4-1.16.1-offboard", "arducopter-4.6.3-guided")
)


@pytest.mark.parametrize(
    ("path", "names"),
    [
        (PX4, "LOCAL_POSITION_NED ATTITUDE_QUATERNION SET_ATTITUDE_TARGET HOME_POSITION"),
        (ARDUCOPTER, "LOCAL_POSITION_NED GLOBAL_POSITION_INT SET_ATTITUDE_TARGET"),
    ],
)
def test_columns_are_what_pymavlink_decodes(path: Path, names: str) -> None:
    theirs = mavutil.mavlogfile(str(path))
    decoded: dict[str, list[Any]] = {name: [] for name in names.split()}
    while (message := theirs.recv_match(type=list(decoded))) is not None:
        decoded[message.get_type()].append(message)
    log = tlog.read(path)
    for name, messages in decoded.items():
        ours = [entry for entry in log if entry.name == name]
        assert len(ours) == len(messages) > 1
        size = tlog.layout(name).itemsize
        payloads = b"".join(entry.frame.payload[:size].ljust(size, b"\0") for entry in ours)
        for field in messages[0].get_fieldnames():
            expected = np.array([np.ravel(getattr(message, field)) for message in messages])
            assert np.array_equal(tlog.columns(name, payloads, field), expected, equal_nan=True)


def test_no_message_gives_no_row_of_the_right_width() -> None:
    assert tlog.columns("SET_ATTITUDE_TARGET", b"", "time_boot_ms q thrust").shape == (0, 6)


def damaged(path: Path, data: bytes) -> tlog.Tlog:
    path.write_bytes(data)
    return tlog.read(path)


def places(log: tlog.Tlog) -> list[int]:
    """Where each entry begins; the log ends where the last one does."""
    return [0, *itertools.accumulate(8 + len(entry.frame.raw) for entry in log)]


@pytest.mark.parametrize(
    ("offset", "byte", "lost"),
    [
        (8 + 12, 0x40, 1),  # payload
        (0, 0x7F, 1),  # time stamp
        (8, 0x55, 1),  # first byte of the frame
        (9, 0xFF, 1),  # length: the frame seems to reach into the next entries
        (9, 0x01, 1),
    ],
)
def test_a_damaged_entry_is_skipped_and_counted(
    offset: int, byte: int, lost: int, tmp_path: Path
) -> None:
    """The first entry, one in the middle, and the last but one."""
    data, whole = PX4.read_bytes(), tlog.read(PX4)
    messages, at = tuple(whole), places(whole)
    for number in (0, len(messages) // 2, len(messages) - 2):
        changed = bytearray(data)
        changed[at[number] + offset] ^= byte
        log = damaged(tmp_path / "x.tlog", bytes(changed))
        assert tuple(log) == (*messages[:number], *messages[number + lost :])
        assert (log.damaged, log.first_damage, log.truncated) == (1, at[number], 0)
        assert log.damage.endswith(f"1 damaged entry was skipped, the first at byte {at[number]}")


def test_entries_after_garbage_and_holes_are_read(tmp_path: Path) -> None:
    """Garbage between entries, a hole that cuts two, and one that cuts the last: 4000 random bytes
    hold about 30 that could begin a frame."""
    data, whole = PX4.read_bytes(), tlog.read(PX4)
    messages, at = tuple(whole), places(whole)
    garbage = np.random.default_rng(3).bytes(4000)
    parts = data[: at[100]], garbage, data[at[100] : at[200] + 7], data[at[203] + 5 : -7]
    log = damaged(tmp_path / "x.tlog", b"".join(parts))
    assert tuple(log) == (*messages[:200], *messages[204:-1])
    assert (log.damaged, log.first_damage) == (2, at[100])
    assert log.truncated == at[-1] - at[-2] - 7
    assert "2 damaged entries were skipped" in log.damage


def test_a_whole_log_is_read_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = list(tlog.read(PX4))
    monkeypatch.setattr(tlog, "_BLOCK", 301)
    assert list(tlog.read(PX4)) == whole


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
