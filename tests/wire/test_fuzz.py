"""Arbitrary input: the session finds the frames in it, and the simulated vehicle keeps running,
sends well-formed frames only, and flies afterwards.

`FUZZ_DATAGRAMS=1000000 pytest tests/wire/test_fuzz.py` sends half a million datagrams to each
firmware, and half a million in flight, before a normal flight. A seed always gives the same ones.
"""

from __future__ import annotations

import itertools
import math
import os
import random
import struct
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_bench import LOITER, NAN, Bench
from vehicle_frames import (
    ARDUCOPTER_RECORDING,
    ARDUPILOT,
    PEER,
    PX4,
    PX4_RECORDING,
    Sender,
    framed,
    pinned,
    recorded,
)

from offboard.mavlink import events
from offboard.mavlink.session import Session
from simulator import config
from simulator.autopilot.firmware import Firmware
from simulator.firmware import FIRMWARES
from simulator.instance import Instance
from simulator.mavlink.codec import Decoder
from simulator.vehicle.conditions import Conditions

COUNT = int(os.environ.get("FUZZ_DATAGRAMS", "5000"))
PER_STEP = 20
# Ids of messages that a vehicle answers or obeys, and of missions; of those that we read
OBEYED = (0, 4, 11, 20, 21, 23, 66, 75, 76, 82, 84, 86, 110, 111, 39, 40, 41, 43, 44, 45, 51, 73)
READ = (0, 1, 2, 22, 24, 31, 32, 75, 76, 77, 83, 111, 148, 193, 230, 245, 253)
COMMANDS = (20, 21, 22, 176, 224, 300, 400, 410, 510, 511, 512, 520)
FLOATS = (math.nan, math.inf, -math.inf, 3.4e38, -3.4e38, 0.0, 1e-42, -1.0, 1.0, 6.0, 493.0)
WORDS = (
    *(struct.pack("<f", value) for value in FLOATS),
    *(struct.pack("<HBB", number, 1, 1) for number in COMMANDS),
    *(bytes((value,)) * 4 for value in (0, 1, 2, 255)),
    *(b"COM_", b"OF_L", b"OSS_", b"T\0\0\0"),
)


def datagrams(seed: int, ids: tuple[int, ...]) -> Iterator[bytes]:
    """Random bytes, mutated recordings, hostile values and lengths, MAVLink 1, in random order."""
    rng = random.Random(seed)
    frames = samples(PX4_RECORDING, ARDUCOPTER_RECORDING)
    makers: tuple[Callable[[], bytes], ...] = (
        lambda: garbage(rng),
        lambda: mutated(rng, rng.choice(frames)),
        lambda: hostile(rng, rng.choice(list(mavlink.mavlink_map))),
        lambda: hostile(rng, rng.choice(ids), version_1=True),
        lambda: b"".join(hostile(rng, rng.choice(ids)) for _ in range(rng.randrange(1, 5))),
        lambda: hostile(rng, rng.choice(ids)) + garbage(rng),
    )
    while True:
        yield rng.choice(makers)()


@cache
def samples(*recordings: Path) -> list[bytes]:
    """Up to 20 frames of each message and component from recordings."""
    kinds: dict[tuple[str, int], list[bytes]] = {}
    for path in recordings:
        for _, frame, message in recorded(path)[:4000]:
            kinds.setdefault((message.get_type(), message.get_srcComponent()), []).append(frame)
    return [frame for found in kinds.values() for frame in found[:20]]


def garbage(rng: random.Random) -> bytes:
    data = bytearray(rng.randbytes(rng.choice((0, 1, 11, 12, 60, 300, 2000))))
    for _ in range(rng.randrange(3) if data else 0):
        data[rng.randrange(len(data))] = rng.choice((0xFD, 0xFE))
    return bytes(data)


def mutated(rng: random.Random, frame: bytes) -> bytes:
    """`frame` with bytes changed, removed or inserted."""
    data = bytearray(frame)
    for _ in range(rng.randrange(1, 4)):
        at = rng.randrange(len(data))
        inserted = rng.randbytes(rng.choice((1, 1, 8)))
        data[at : rng.choice((at, at + 1, at + 1, len(data)))] = inserted
    return bytes(data)


def hostile(rng: random.Random, message_id: int, *, version_1: bool = False) -> bytes:
    """A frame of hostile values with a valid checksum; one in four has a random length."""
    kind = mavlink.mavlink_map[message_id]
    words = [rng.choice(WORDS) if rng.random() < 0.8 else rng.randbytes(4) for _ in range(64)]
    length = rng.randrange(256) if rng.random() < 0.25 else kind.unpacker.size
    return framed(message_id, b"".join(words)[:length], version_1=version_1 and message_id < 256)


# --- the session ---


def receive(session: Session, data: bytes) -> list[bytes]:
    """The frames found. Every number of an event must be finite."""
    reception = session.receive(data, PEER, 0.0)
    for event in reception.events:
        for name in event.__dataclass_fields__:
            assert all(math.isfinite(x) for x in floats(getattr(event, name)))
        if isinstance(event, events.Attitude):
            assert math.hypot(*event.attitude) == pytest.approx(1.0)
    return reception.frames


def floats(value: object) -> Iterator[float]:
    if isinstance(value, float):
        yield value
    elif isinstance(value, tuple):
        for part in value:
            yield from floats(part)


@pytest.mark.parametrize("autopilot", [PX4, ARDUPILOT])
@pytest.mark.parametrize("stream", [False, True])
def test_session_survives_hostile_datagrams(autopilot: int, stream: bool) -> None:
    """A frame with a valid checksum counts at any length: a shorter payload is padded, a longer one
    is of a later version of MAVLink. SETUP_SIGNING (256) holds a key and is not logged."""
    session, found, sent = pinned(Sender(), autopilot, stream=stream), 0, 0
    before = session.splitter.bytes_received
    for datagram in itertools.islice(datagrams(3, READ), 2000):
        found += sum(map(len, receive(session, datagram)))
        sent += len(datagram)
    splitter, generator = session.splitter, random.Random(3)
    assert splitter.bytes_received == before + sent
    assert 0 < splitter.bytes_skipped <= sent - found
    for message_id in sorted(mavlink.mavlink_map):
        frame = hostile(generator, message_id)
        session = pinned(Sender(), autopilot, stream=stream)
        assert receive(session, frame) == ([frame] if message_id != 256 else [])
        assert session.splitter.bytes_skipped == 0


def test_false_length_in_garbage_hides_no_frame() -> None:
    """The length in a false header with an unknown id covers three good frames of two reads, or all
    but the last byte of the third, where the first read ends and a frame could begin."""
    sender = Sender(7)
    frames = [sender.heartbeat(PX4) for _ in range(6)]
    reach = sum(map(len, frames[:3]))
    for garbage, length, split in ((b"\0\1", reach - 2, 17), (b"", reach - 3, 9 + reach)):
        session = pinned(sender, PX4, stream=True)
        false = garbage + bytes((0xFD, length, 0, 0, 0, 7, 1, 0xAA, 0xBB, 0x77))
        data = false + b"".join(frames)
        assert [*receive(session, data[:split]), *receive(session, data[split:])] == frames


def test_unusual_frames_are_accepted_or_refused() -> None:
    """Unknown incompatibility flags are refused; a signed frame includes its signature. A frame
    with an unknown id counts only before another frame; garbage like it hides no frame."""
    session, good, outer = pinned(Sender()), Sender().position(1000), Sender().position(2000)
    for flags in (0x02, 0xFE):
        assert receive(session, good[:2] + bytes([flags]) + good[3:]) == []
    signed = Sender(key=bytes(32), stamp=1).position(1000)
    assert receive(session, signed + outer) == [signed, outer]
    unknown = bytes([0xFD, len(good), 0, 0, 0, 1, 1, 0xFF, 0xFF, 0xFF]) + good + b"\0\0"
    for before in (b"", b"\0"):  # each datagram begins anew
        assert receive(session, before) == []
        assert receive(session, unknown + outer) == [outer]
    assert receive(session, b"\0" + unknown + outer) == [good, outer]


# --- the simulated vehicle ---


def assault(instance: Instance, seed: int, count: int) -> None:
    """Feed both links while time passes. All that the vehicle sends must be well formed."""
    reader = Decoder()
    for index, datagram in enumerate(itertools.islice(datagrams(seed, OBEYED), count)):
        (instance.feed if index % 4 else instance.feed_ground)(datagram)
        if index % PER_STEP == 0:
            instance.advance()
            for datagram_out in (*instance.drain(), *instance.drain_ground()):
                for m in reader.read(datagram_out):
                    assert m.get_type() != "LOCAL_POSITION_NED" or math.isfinite(m.x + m.y + m.z)
    assert not reader.dropped


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("firmware", FIRMWARES.values(), ids=FIRMWARES)
def test_simulated_vehicle_survives_hostile_datagrams(firmware: Firmware) -> None:
    vehicle = config.vehicle(firmware.vehicle)
    instance = Instance(firmware, vehicle, Conditions(), 1)
    assault(instance, 5, COUNT // 2)
    reasons = {"checksum", "truncated", "not a frame", "unknown message", "incompatible flags"}
    assert reasons <= set(instance.companion.decoder.dropped)


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_simulated_vehicle_flies_after_hostile_datagrams() -> None:
    bench = Bench(ground_link=True)
    bench.fly_offboard()
    assault(bench.instance, 6, COUNT // 2)
    autopilot = bench.instance.autopilot
    bench.command(21)
    bench.run_until(lambda: autopilot.position_controller.landed, 1000.0)
    bench.command(400, 0, 21196)
    for spec in FIRMWARES["px4"].parameters:
        autopilot.parameters.set(spec.name, spec.default)
    begun_s = bench.time_s
    assert bench.ask_mode(LOITER) == [0, 0]
    assert bench.command(400, 1) == [0]
    assert bench.command(22, *(NAN,) * 7) == [0]
    bench.run_until(lambda: bench.mode == LOITER, 15.0)
    bench.run(2.0)
    assert bench.height_m == pytest.approx(2.5, abs=0.3)
    assert bench.command(21) == [0]
    bench.run_until(lambda: not bench.armed, 20.0)
    assert bench.texts(begun_s)[-1] == "Disarmed by landing"
