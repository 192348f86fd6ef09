"""The simulator's decoder: messages of pymavlink, and arbitrary bytes."""

from __future__ import annotations

import math
import random
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from simulator.mavlink import codec

ASKED = (
    "COMMAND_LONG",
    "COMMAND_INT",
    "SET_ATTITUDE_TARGET",
    "SET_POSITION_TARGET_LOCAL_NED",
    "PARAM_SET",
    "PARAM_REQUEST_READ",
)
INTEGERS = {
    f"{sign}int{bits}_t": (bits, sign == "") for bits in (8, 16, 32, 64) for sign in ("", "u")
}


def message_class(name: str) -> type:
    return mavlink.mavlink_map[getattr(mavlink, f"MAVLINK_MSG_ID_{name}")]


def random_values(name: str, rng: random.Random) -> list[object]:
    """One value per field in XML order; trailing zeros are likely, to exercise truncation."""
    kind = message_class(name)
    values: list[object] = []
    for index, field_type in zip(kind.orders, kind.fieldtypes, strict=True):
        length = kind.array_lengths[index]
        if field_type == "char":
            text = "".join(rng.choices("ABC_x", k=rng.randint(0, max(1, length))))
            values.append(text.encode())
        elif length:
            values.append([_number(field_type, rng) for _ in range(length)])
        else:
            values.append(_number(field_type, rng))
    return values


def _number(field_type: str, rng: random.Random) -> float | int:
    if rng.random() < 0.3:
        return 0
    if field_type in INTEGERS:
        bits, signed = INTEGERS[field_type]
        low = -(1 << bits - 1) if signed else 0
        return rng.randint(low, low + (1 << bits) - 1)
    return struct.unpack("<f", struct.pack("<f", rng.uniform(-1e6, 1e6)))[0]


@pytest.mark.parametrize("name", ASKED)
def test_decodes_frames_of_pymavlink(name: str) -> None:
    rng = random.Random(name)
    decoder = codec.Decoder()
    for _ in range(40):
        sent = message_class(name)(*random_values(name, rng))
        (message,) = decoder.read(sent.pack(mavlink.MAVLink(None, srcSystem=3, srcComponent=7)))
        assert (message.name, message.system, message.component) == (name, 3, 7)
        known = mavlink.MAVLink(None).parse_buffer(sent.get_msgbuf())[0].to_dict()
        known.pop("mavpackettype")
        assert {k: v for k, v in message.values.items() if k in known} == known
    assert not decoder.dropped


def packed_command(number: int) -> bytes:
    message = mavlink.MAVLink_command_long_message(1, 1, number, 0, *(math.nan,) * 7)
    return bytes(message.pack(mavlink.MAVLink(None)))


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=60).filter(lambda b: not set(b) & {0xFD, 0xFE}))
def test_garbage_in_a_datagram_hides_no_frame(garbage: bytes) -> None:
    decoder = codec.Decoder()
    messages = decoder.read(garbage + packed_command(400) + garbage + packed_command(176))
    assert [m.command for m in messages] == [400, 176]
    assert decoder.dropped["not a frame"] == 2 * len(garbage)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda raw: raw[:-1], "truncated"),
        (lambda raw: raw[:12] + bytes([raw[12] ^ 1]) + raw[13:], "checksum"),
        (lambda raw: raw[:2] + b"\x02" + raw[3:], "incompatible flags"),
        (lambda raw: raw[:7] + b"\xff\xff\x7f" + raw[10:], "unknown message"),
        (lambda raw: b"", None),
    ],
)
def test_undecodable_bytes_are_counted_by_reason(spoil: object, reason: str | None) -> None:
    decoder = codec.Decoder()
    assert decoder.read(spoil(packed_command(400))) == []
    assert (reason is None and not decoder.dropped) or decoder.dropped[reason] == 1
