"""The simulator's decoder: messages of pymavlink, and arbitrary bytes."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from simulator.mavlink import codec


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
