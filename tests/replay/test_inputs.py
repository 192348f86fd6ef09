"""The record of a turn's inputs: what is read is what was recorded, and damage is noticed."""

from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from offboard.flight.record import (
    CHECK,
    OTHERS,
    ChunkInput,
    Entry,
    InputRecorder,
    InputsError,
    Note,
    TurnInput,
    entries,
)
from offboard.link.interface import Chunk
from offboard.mavlink.session import Reception, SessionSettings

PEERS = (("127.0.0.1", 14580), ("::1", 14580, 0, 0), "serial")
MICROSECONDS = st.integers(0, 10**13)
CHUNKS = st.tuples(
    st.sampled_from(PEERS),
    st.integers(-(10**7), 10**7),  # us before the turn
    st.lists(st.binary(min_size=12, max_size=280), max_size=4),
    st.lists(st.tuples(st.integers(0, 4), st.binary(min_size=8, max_size=280)), max_size=2),
)
TURNS = st.lists(
    st.tuples(
        MICROSECONDS,
        st.integers(0, 10**6),
        st.lists(CHUNKS, max_size=3),
        st.lists(st.integers(-10, 10**6), max_size=20),
        st.booleans(),
    ),
    max_size=12,
)


@settings(max_examples=60, deadline=None)
@given(TURNS)
def test_what_is_read_is_what_was_recorded(turns) -> None:
    recorder, pieces = InputRecorder(SessionSettings()), []
    expected: list[Entry] = []
    other_datagrams, now_us = 0, 0
    read = recorder.watch(lambda: now_us / 1e6)
    for at_us, counted, chunks, readings, is_tick in turns:
        if counted != other_datagrams:
            expected.append(Note(OTHERS, (counted,)))
        other_datagrams, now_us = counted, at_us
        assert recorder.begin(at_us / 1e6 + 2e-7, counted) == at_us / 1e6
        for peer, before_us, frames, unlogged in chunks:
            chunk = Chunk(b"", peer, (at_us - before_us) / 1e6)
            recorder.chunk(chunk, Reception(tuple(frames), unlogged=tuple(unlogged)))
        for step_us in readings:
            now_us += step_us
            assert read() == now_us / 1e6
        recorder.end()
        stamps = tuple((at_us + sum(readings[: n + 1])) / 1e6 for n in range(len(readings)))
        expected.append(
            TurnInput(
                at_us / 1e6,
                tuple(
                    ChunkInput(peer, (at_us - before_us) / 1e6, len(frames), tuple(unlogged))
                    for peer, before_us, frames, unlogged in chunks
                ),
                stamps,
            )
        )
        pieces += recorder.pieces(all_of_it=is_tick)
    pieces += recorder.pieces(all_of_it=True)
    assert all(len(piece.data) <= 128 for piece in pieces)
    found = list(entries(piece.data for piece in pieces))
    assert [each for each in found[1:] if getattr(each, "kind", "") != CHECK] == expected


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


def test_in_lockstep_no_host_time_is_recorded() -> None:
    def pieces(offset_s: float, port: int) -> list[bytes]:
        recorder = InputRecorder(SessionSettings(lockstep=True))
        read = recorder.watch(lambda: offset_s)
        for number in range(50):
            now_s = offset_s * number
            recorder.begin(now_s, 0)
            if number % 3:  # the machine was busy: a turn in which nothing had arrived
                recorder.chunk(Chunk(b"", ("127.0.0.1", port), now_s), Reception((b"frame",)))
            read()
            recorder.end()
        return [piece.data for piece in recorder.pieces(all_of_it=True)]

    assert pieces(0.01, 14580) == pieces(0.37, 20000)
    first = next(entries(pieces(0.01, 14580)))
    assert isinstance(first, Note)
    assert first.values[1]["lockstep"] is True
