"""Reading of a .tlog: messages and columns against pymavlink, and damaged entries."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from pymavlink import mavutil

from offboard.analysis import history, tlog
from offboard.documents.errors import UserError
from offboard.link.log import entry as written

RECORDINGS = Path(__file__).parents[1] / "wire" / "recordings"
PX4, ARDUCOPTER = (
    RECORDINGS / f"{name}.tlog" for name in ("px4-1.16.1-offboard", "arducopter-4.6.3-guided")
)


@cache
def recorded() -> tuple[bytes, tuple[tlog.LoggedMessage, ...], list[int]]:
    """The first 500 entries of PX4's log: bytes, messages, and the offsets at which they
    begin and the last one ends (501)."""
    messages = tuple(itertools.islice(tlog.read(PX4), 500))
    at = [0, *itertools.accumulate(8 + len(entry.frame.raw) for entry in messages)]
    return PX4.read_bytes()[: at[-1]], messages, at


@pytest.mark.parametrize("path", [PX4, ARDUCOPTER])
def test_message_layouts_agree_with_pymavlink(path: Path) -> None:
    """The first five messages of each name are compared, field by field."""
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


DAMAGES = (
    (8 + 12, 0x40),  # payload
    (0, 0x7F),  # time stamp
    (8, 0x55),  # first byte of the frame
    (9, 0xFF),  # length: the frame seems to reach into the next entries
    (9, 0x01),
)


def damaged_logs() -> Iterator[tuple[bytes, set[int], int, int | None, int]]:
    """Damaged logs: bytes, numbers of the lost messages, count of damages, offset of the first one,
    and size in bytes of an entry that is cut at the end."""
    data, messages, at = recorded()
    last, size = len(messages) - 1, at[-1] - at[-2]

    def flipped(number: int, offset: int, byte: int) -> bytes:
        changed = bytearray(data)
        changed[at[number] + offset] ^= byte
        return bytes(changed)

    for number in (0, len(messages) // 2, last - 1):
        for damage in DAMAGES:
            yield flipped(number, *damage), {number}, 1, at[number], 0
    yield flipped(last, size - 1, 1), {last}, 1, at[-2], 0  # checksum
    yield data[:-3], {last}, 0, None, size - 3
    yield data + bytes(5000), set(), 1, at[-1], 0
    # garbage between entries, with about 30 bytes that could begin a frame; a hole that cuts two
    # entries; and a cut in the last entry
    garbage = np.random.default_rng(3).bytes(4000)
    parts = data[: at[100]], garbage, data[at[100] : at[200] + 7], data[at[203] + 5 : -7]
    yield b"".join(parts), {200, 201, 202, 203, last}, 2, at[100], size - 7
    for short in range(12):  # the border of a block lies within an entry
        yield bytes(1000 - short) + data, set(), 1, 0, 0


@pytest.mark.parametrize("block", [1000, tlog._BLOCK])
def test_damaged_entries_are_skipped_and_counted(
    block: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tlog, "_BLOCK", block)
    _, messages, _ = recorded()
    for data, lost, damages, first, truncated in damaged_logs():
        (tmp_path / "x.tlog").write_bytes(data)
        log = tlog.read(tmp_path / "x.tlog")
        assert tuple(log) == tuple(m for n, m in enumerate(messages) if n not in lost)
        assert (log.damaged, log.truncated) == (damages, truncated)
        if damages:
            assert log.first_damage == first
            words = "entries were" if damages > 1 else "entry was"
            told = f"{damages} damaged {words} skipped, the first at byte {first}"
            assert told in log.unread


def test_log_with_time_stamps_of_1970_is_read(tmp_path: Path) -> None:
    """Its time stamps begin in 1970, because of which its flights once could not be scored."""
    _, messages, _ = recorded()
    log = tmp_path / "1970.tlog"
    since_us = messages[0].unix_us
    log.write_bytes(b"".join(written(m.unix_us - since_us, m.frame.raw) for m in messages))
    assert [m.frame for m in tlog.read(log)] == [m.frame for m in messages]


def test_texts_and_refusals_get_the_vehicle_time() -> None:
    """Every text and refusal has the time of the newest telemetry before it in the file. A text in
    chunks (STATUSTEXT.id) is complete once a chunk has fewer than 50 bytes."""
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


def test_frames_without_time_stamps_are_no_log(tmp_path: Path) -> None:
    """MAVProxy writes such a file beside its log: mav.tlog.raw. Bytes of a frame may look like a
    time stamp before the next frame."""
    raw = tmp_path / "mav.tlog.raw"
    raw.write_bytes(b"".join(m.frame.raw for m in tlog.read(PX4)))
    with pytest.raises(UserError, match=r"not a \.tlog: it has no time stamp"):
        tlog.read(raw)
