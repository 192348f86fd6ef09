"""The record of a turn's inputs: what is read is what was recorded, and damage is noticed."""

from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from offboard.flight.inputs import (
    InputRecorder,
    InputsError,
    entries,
)
from offboard.link.interface import Chunk
from offboard.mavlink.session import Reception, SessionSettings


def recorded(turns: int) -> list[bytes]:
    recorder = InputRecorder(SessionSettings())
    for number in range(turns):
        now_s = 100.0 + 0.01 * number + 1e-6 * (number * 7919 % 1000)
        recorder.begin(now_s, 0)
        frame = (number * 104729 % 2**24).to_bytes(3, "big")
        recorder.chunk(Chunk(b"", "tcp", now_s), Reception((), unlogged=((0, frame),)))
        recorder.end()
    return [piece.data for piece in recorder.pieces(all_of_it=True)]


def test_a_missing_piece_ends_the_reading_with_a_reason() -> None:
    pieces = recorded(200)
    assert len(pieces) > 8
    with pytest.raises(InputsError, match="piece 3 is missing"):
        list(entries(pieces[:3] + pieces[4:]))
    whole, cut = list(entries(pieces)), list(entries(pieces[:3]))
    assert 20 < len(cut) < len(whole)
    assert whole[: len(cut)] == cut


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_damaged_pieces_raise_nothing_else(data) -> None:
    pieces = [bytearray(piece) for piece in recorded(60)]
    for _ in range(data.draw(st.integers(1, 5))):
        piece = data.draw(st.sampled_from(pieces))
        piece[data.draw(st.integers(0, len(piece) - 1))] = data.draw(st.integers(0, 255))
    with suppress(InputsError):
        list(entries(map(bytes, pieces)))
