"""An endless sequence of hostile datagrams; the same seed gives the same ones."""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable, Iterator

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_frames import ARDUCOPTER_RECORDING, PX4_RECORDING

KINDS = list(mavlink.mavlink_map.values())
OBEYED = [  # what a vehicle answers or obeys
    mavlink.mavlink_map[number]
    for number in (
        *(0, 4, 11, 20, 21, 23, 66, 75, 76, 82, 84, 86, 110, 111),
        *(39, 40, 41, 43, 44, 45, 51, 73),  # missions
    )
]
COMMANDS = (20, 21, 22, 176, 224, 300, 400, 410, 510, 511, 512, 520)
FLOATS = (math.nan, math.inf, -math.inf, 3.4e38, -3.4e38, 0.0, 1e-42, -1.0, 1.0, 6.0, 493.0)


def datagrams(seed: int) -> Iterator[bytes]:
    """Random bytes, mutated recordings, hostile values, other lengths, MAVLink 1, by turns."""
    rng = random.Random(seed)
    writer = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    frames = recorded()
    makers: tuple[Callable[[], bytes], ...] = (
        lambda: garbage(rng),
        lambda: mutated(rng, rng.choice(frames)),
        lambda: hostile(rng, writer, OBEYED),
        lambda: hostile(rng, writer, KINDS),
        lambda: hostile(rng, writer, OBEYED, version_1=True),
        lambda: resized(rng, hostile(rng, writer, OBEYED)),
        lambda: b"".join(hostile(rng, writer, OBEYED) for _ in range(rng.randrange(2, 5))),
        lambda: hostile(rng, writer, OBEYED) + garbage(rng),
    )
    while True:
        yield rng.choice(makers)()


def recorded() -> list[bytes]:
    """Frames of both recordings, some of each kind."""
    kinds: dict[tuple[str, int], list[bytes]] = {}
    for path in (PX4_RECORDING, ARDUCOPTER_RECORDING):
        log = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
        while (message := log.recv_match()) is not None:
            key = (message.get_type(), message.get_srcComponent())
            found = kinds.setdefault(key, [])
            if len(found) < 20:
                found.append(bytes(message.get_msgbuf()))
        log.close()
    return [frame for found in kinds.values() for frame in found]


def garbage(rng: random.Random) -> bytes:
    data = bytearray(rng.randbytes(rng.choice((0, 1, 11, 12, 60, 300, 2000))))
    for _ in range(rng.randrange(3)):
        if data:
            data[rng.randrange(len(data))] = rng.choice((0xFD, 0xFE))
    return bytes(data)


def mutated(rng: random.Random, frame: bytes) -> bytes:
    data = bytearray(frame)
    for _ in range(rng.randrange(1, 4)):
        at = rng.randrange(len(data))
        way = rng.randrange(4)
        if way == 0:
            data[at] ^= 1 << rng.randrange(8)
        elif way == 1:
            del data[at + 1 :]
        elif way == 2:
            data[at:at] = rng.randbytes(rng.randrange(1, 9))
        else:
            data[at] = rng.randrange(256)
    return sealed(bytes(data)) if rng.random() < 0.5 else bytes(data)


def resized(rng: random.Random, frame: bytes) -> bytes:
    """Another payload length under a right checksum: what a later MAVLink would send."""
    payload = (frame[10:-2] + rng.randbytes(255))[: rng.randrange(256)]
    return sealed(frame[:1] + bytes((len(payload),)) + frame[2:10] + payload + b"\0\0")


def sealed(frame: bytes) -> bytes:
    """The frame with the checksum that its bytes ask for, if it is one."""
    if len(frame) < 12 or frame[0] != 0xFD:
        return frame
    kind = mavlink.mavlink_map.get(int.from_bytes(frame[7:10], "little"))
    if kind is None or len(frame) < 12 + frame[1]:
        return frame
    stop = 10 + frame[1]
    crc = mavlink.x25crc(frame[1:stop])
    crc.accumulate(bytes((kind.crc_extra,)))
    return frame[:stop] + struct.pack("<H", crc.crc) + frame[stop + 2 :]


def hostile(
    rng: random.Random, writer: mavlink.MAVLink, kinds: list[type], *, version_1: bool = False
) -> bytes:
    """A frame with a right checksum and wrong values."""
    kind = rng.choice(kinds)
    if version_1:
        kind = kind if kind.id < 256 else mavlink.mavlink_map[76]
    message = kind(*(values_of(rng, kind)))
    writer.srcSystem, writer.srcComponent = rng.choice(((1, 191), (255, 190), (0, 0), (7, 1)))
    return bytes(message.pack(writer, force_mavlink1=version_1))


def values_of(rng: random.Random, kind: type) -> list[object]:
    values: list[object] = []
    for name, index, field_type in zip(kind.fieldnames, kind.orders, kind.fieldtypes, strict=True):
        length = kind.array_lengths[index]
        if name == "command" and not length and rng.random() < 0.9:
            values.append(rng.choice(COMMANDS))
        elif name in ("target_system", "target_component"):
            values.append(rng.choice((0, 1, 1, 1, 2, 255)))
        elif field_type == "char":
            values.append(rng.choice((b"COM_OF_LOSS_T", b"MPC_THR_HOVER", rng.randbytes(length))))
        elif length:
            values.append([number(rng, field_type) for _ in range(length)])
        else:
            values.append(number(rng, field_type))
    return values


def number(rng: random.Random, field_type: str) -> float | int:
    if field_type in ("float", "double"):
        return rng.choice(FLOATS) if rng.random() < 0.8 else rng.uniform(-1000.0, 1000.0)
    bits = int("".join(c for c in field_type if c.isdigit()))
    low = 0 if field_type.startswith("uint") else -(1 << bits - 1)
    high = low + (1 << bits) - 1
    return rng.choice((low, high, 0, 1, 2, 3, 4, 6, rng.randint(low, high)))
