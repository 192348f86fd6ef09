"""No received bytes raise, exhaust the memory, or remain uncounted."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_frames import ARDUPILOT, PEER, PX4, PX4_RECORDING, Sender, framed, pinned, recorded

from offboard.mavlink import events
from offboard.mavlink.counters import DropReason
from offboard.mavlink.session import Session

LONGEST_FRAME = 10 + 255 + 2 + 13


def receive(session: Session, data: bytes) -> tuple[bytes, ...]:
    """The frames found; every number of an event is finite, every byte is counted once."""
    reception = session.receive(data, PEER, 0.0)
    for event in reception.events:
        for name in event.__dataclass_fields__:
            assert all(math.isfinite(x) for x in floats(getattr(event, name)))
        if isinstance(event, events.Attitude):
            assert math.hypot(*event.attitude) == pytest.approx(1.0)
    counted = session.counters
    assert counted.bytes_received == (
        counted.bytes_framed + counted.bytes_skipped + counted.bytes_pending
    )
    assert counted.bytes_pending <= LONGEST_FRAME
    return reception.frames


def floats(value: object) -> Iterator[float]:
    if isinstance(value, float):
        yield value
    elif isinstance(value, tuple):
        for part in value:
            yield from floats(part)


@pytest.fixture(scope="module")
def traffic() -> list[bytes]:
    """Real frames of every kind that PX4 sends."""
    kinds: dict[str, list[bytes]] = {}
    for message in recorded(PX4_RECORDING):
        kinds.setdefault(message.get_type(), []).append(bytes(message.get_msgbuf()))
    found = [frame for frames in kinds.values() for frame in frames[:8]]
    return [each for each in found if int.from_bytes(each[7:10], "little") in mavlink.mavlink_map]


@given(
    st.lists(st.binary(max_size=400), max_size=8), st.booleans(), st.sampled_from([PX4, ARDUPILOT])
)
@settings(max_examples=100, deadline=None, derandomize=True)
def test_any_bytes(portions: list[bytes], stream: bool, autopilot: int) -> None:
    session = pinned(Sender(), autopilot, stream=stream)
    for portion in portions:
        receive(session, portion)


DECODED = [0, 1, 2, 22, 24, 31, 32, 75, 76, 77, 83, 111, 148, 193, 230, 245, 253]
IDS = st.sampled_from(DECODED) | st.sampled_from(sorted(mavlink.mavlink_map))


@given(st.binary(max_size=255), IDS, st.booleans())
@settings(max_examples=700, deadline=None, derandomize=True)
def test_any_payload_with_a_correct_checksum(payload: bytes, message_id: int, px4: bool) -> None:
    """Any length: a shorter payload is padded, a longer one belongs to a later MAVLink version."""
    session = pinned(Sender(), PX4 if px4 else ARDUPILOT)
    frame = framed(message_id, payload)
    logged = message_id != 256  # SETUP_SIGNING, which holds a key
    assert receive(session, frame) == ((frame,) if logged else ())


@pytest.mark.parametrize("stream", [False, True])
def test_damaged_frames(traffic: list[bytes], stream: bool) -> None:
    generator = np.random.default_rng(0)
    session = pinned(Sender(7), PX4, stream=stream)
    for frame in traffic * 4:
        damaged = bytearray(frame)
        for _ in range(generator.integers(0, 4)):
            damaged[generator.integers(len(damaged))] = generator.integers(256)
        if generator.random() < 0.2:
            del damaged[generator.integers(len(damaged)) :]
        if generator.random() < 0.2:
            damaged += generator.bytes(generator.integers(1, 50))
        receive(session, bytes(damaged))
    assert session.counters.dropped[DropReason.BAD_CRC] > 50
    assert session.counters.frames > 200  # a fifth goes undamaged


@pytest.mark.parametrize("seed", range(2))
def test_good_frames_survive_garbage_between_them(traffic: list[bytes], seed: int) -> None:
    """Also behind garbage that begins like a long frame."""
    generator = np.random.default_rng(seed)
    session = pinned(Sender(7), PX4, stream=True)
    data = b""
    for frame in traffic:
        data += generator.bytes(generator.integers(0, 40)) + b"\xfd\xff" + frame
    found: list[bytes] = []
    for at in range(0, len(data), 100):
        found += receive(session, data[at : at + 100])
    found += receive(session, bytes(LONGEST_FRAME))
    ours = [frame for frame in traffic if frame[6] == 191]
    assert found == [frame for frame in traffic if frame not in ours]
    assert session.counters.dropped[DropReason.SAME_IDS] == len(ours)


def test_a_length_in_garbage_hides_no_frame_of_the_next_read() -> None:
    """A false start with an unknown id, whose length covers three good frames of two reads; or the
    third but for a byte, at the end of the first read, where a frame could begin."""
    sender = Sender(7)
    frames = [sender.heartbeat(PX4) for _ in range(6)]
    reach = sum(map(len, frames[:3]))
    for garbage, length, split in ((b"\0\1", reach - 2, 17), (b"", reach - 3, 9 + reach)):
        session = pinned(sender, PX4, stream=True)
        false = garbage + bytes((0xFD, length, 0, 0, 0, 7, 1, 0xAA, 0xBB, 0x77))
        data = false + b"".join(frames)
        assert [*receive(session, data[:split]), *receive(session, data[split:])] == frames


def test_frames_that_are_unusual() -> None:
    """Unknown incompatibility flags are refused; a signed frame includes its signature; one with an
    unknown id needs another frame behind it, and garbage like it hides none."""
    session, good, outer = pinned(Sender()), Sender().position(1000), Sender().position(2000)
    for flags in (0x02, 0xFE):
        assert receive(session, good[:2] + bytes([flags]) + good[3:]) == ()
    assert session.counters.dropped[DropReason.INCOMPATIBLE] == 2
    signed = Sender(key=bytes(32), stamp=1).position(1000)
    assert receive(session, signed + outer) == (signed, outer)
    unknown = bytes([0xFD, len(good), 0, 0, 0, 1, 1, 0xFF, 0xFF, 0xFF]) + good + b"\0\0"
    assert receive(session, unknown + outer) == (outer,)
    assert session.counters.dropped[DropReason.UNKNOWN_ID] == 1
    assert receive(session, b"\0" + unknown + outer) == (good, outer)


def test_many_start_bytes_use_bounded_time_and_memory() -> None:
    session = pinned(Sender(), stream=True)
    for _ in range(5):
        receive(session, b"\xfd" * 10_000)
        receive(session, b"\xfe" * 10_000)
    assert session.counters.bytes_skipped > 90_000
