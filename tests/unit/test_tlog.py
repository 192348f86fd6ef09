"""A .tlog read by columns against pymavlink, message by message, and with damage in it."""

from __future__ import annotations

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
        ours = [entry for entry in log.messages if entry.name == name]
        assert len(ours) == len(messages) > 1
        for field in messages[0].get_fieldnames():
            expected = np.array([np.ravel(getattr(message, field)) for message in messages])
            assert np.array_equal(tlog.columns(name, ours, field), expected, equal_nan=True), field


def test_no_message_gives_no_row_of_the_right_width() -> None:
    assert tlog.columns("SET_ATTITUDE_TARGET", [], "time_boot_ms q thrust").shape == (0, 6)


def test_a_damaged_frame_is_counted_and_left_out(tmp_path: Path) -> None:
    data = bytearray(PX4.read_bytes())
    whole = tlog.read(PX4)
    data[8 + 12] ^= 0x40  # in the payload of the first record
    (tmp_path / "damaged.tlog").write_bytes(data)
    damaged = tlog.read(tmp_path / "damaged.tlog")
    assert (damaged.undecodable, damaged.truncated) == (1, 0)
    assert damaged.messages == whole.messages[1:]


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
