"""Inputs of a flight, recorded so that `offboard replay` can give it the same ones again.

The log holds every frame that was received. What else a turn depends on is recorded here: its host
time, which frames arrived together, when and from whom, each reading of the stopwatch, and what the
loop requested. Host times are whole microseconds, rounded before the flight sees them, so that
the record is exact. In lockstep nothing depends on host time, and none is recorded.

The record is a sequence of entries in TUNNEL messages of our record component. Numbers are
variable-length integers of seven bits a byte, signed ones zigzag.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from offboard.link.interface import Chunk
from offboard.mavlink.outgoing import ConfigurationRecord
from offboard.mavlink.session import Reception, SessionSettings

PAYLOAD_TYPE = 0xC0F2  # TUNNEL.payload_type; numbers above 32767 need no registration
_HEAD = struct.Struct("<I")  # number of the piece
_PIECE_BYTES = 128 - _HEAD.size
_TURN, _CALL, _PEER, _OTHERS, _DROPPED, _CHECK = range(6)
SETTINGS = "settings"  # the first call: how the session was set


class InputRecorder:
    """Records the inputs of one `Flight`; see the module. With `kept` False nothing: a flight of
    a service goes on with what was known before, which its log does not hold."""

    def __init__(self, settings: SessionSettings, *, kept: bool = True) -> None:
        self._kept = kept
        self._timed = not settings.lockstep
        self._data = bytearray()  # entries that are not in a piece yet
        self._pieces = 0
        self._now_us = 0
        self._read_us = 0
        self._peers: dict[Hashable, int] = {}
        self._other_datagrams = 0
        self._chunks: list[bytes] = []  # of the turn in progress
        self._readings: list[bytes] = []
        self._crc = 0  # of the frames since the last check
        self.call(
            SETTINGS,
            {
                "system_id": settings.system_id,
                "lockstep": settings.lockstep,
                "stream": settings.stream,
                "sends_first": settings.sends_first,
                "capacity_bytes_ps": settings.capacity_bytes_ps,
            },
        )

    def begin(self, now_s: float, other_datagrams: int) -> float:
        """A turn begins. Returns its time as it is recorded."""
        if other_datagrams != self._other_datagrams:
            self._data += bytes([_OTHERS]) + _varint(other_datagrams)
            self._other_datagrams = other_datagrams
        before_us, self._now_us = self._now_us, round(now_s * 1e6)
        self._chunks, self._readings = [], []
        self._head = _zigzag(self._now_us - before_us) if self._timed else b""
        self._read_us = self._now_us
        return self._now_us / 1e6

    def arrived_s(self, chunk: Chunk) -> float:
        """The time of arrival of a chunk as it is recorded."""
        return round(chunk.arrived_s * 1e6) / 1e6

    def chunk(self, chunk: Chunk, reception: Reception) -> None:
        """A chunk of this turn, and what was found in it."""
        for frame in reception.frames:
            self._crc = zlib.crc32(frame, self._crc)
        others = reception.unlogged
        row = _varint(self._peer(chunk.peer) << 1 | bool(others))
        if self._timed:
            row += _zigzag(self._now_us - round(chunk.arrived_s * 1e6))
        row += _varint(len(reception.frames))
        if others:
            row += _varint(len(others))
            for place, frame in others:
                row += _varint(place) + _varint(len(frame)) + frame
        self._chunks.append(row)

    def watch(self, stopwatch: Callable[[], float]) -> Callable[[], float]:
        """The same stopwatch, whose readings are recorded."""

        def read() -> float:
            read_us = round(stopwatch() * 1e6)
            if self._timed:
                self._readings.append(_zigzag(read_us - self._read_us))
                self._read_us = read_us
            return read_us / 1e6

        return read

    def end(self) -> None:
        """The turn ends. In lockstep one in which nothing arrived changes nothing."""
        if self._timed or self._chunks:
            self._data.append(_TURN)
            self._data += self._head + _varint(len(self._chunks)) + b"".join(self._chunks)
            if self._timed:
                self._data += _varint(len(self._readings)) + b"".join(self._readings)

    def call(self, name: str, *arguments: object) -> None:
        """A method of the flight was called between two turns."""
        text = json.dumps([name, *arguments]).encode()
        self._data += bytes([_CALL]) + _varint(len(text)) + text

    def dropped(self, frames: int) -> None:
        """The loop has not sent the last frames of the turn."""
        self._data += bytes([_DROPPED]) + _varint(frames)

    def pieces(self, *, all_of_it: bool) -> list[ConfigurationRecord]:
        """Records for the log: the full ones, or all that there is."""
        if not self._kept:
            self._data.clear()
            return []
        if all_of_it and self._data:
            self._data.append(_CHECK)
            self._data += struct.pack("<H", self._crc & 0xFFFF)
            self._crc = 0
        records: list[ConfigurationRecord] = []
        while len(self._data) >= _PIECE_BYTES or (all_of_it and self._data):
            data = _HEAD.pack(self._pieces) + bytes(self._data[:_PIECE_BYTES])
            records.append(ConfigurationRecord(data, PAYLOAD_TYPE))
            self._pieces += 1
            del self._data[:_PIECE_BYTES]
        return records

    def _peer(self, peer: Hashable) -> int:
        number = self._peers.get(peer)
        if number is None:
            number = self._peers[peer] = len(self._peers)
            # in lockstep the simulator's port differs from run to run, and does not matter
            text = json.dumps(peer if self._timed else number).encode()
            self._data += bytes([_PEER]) + _varint(len(text)) + text
        return number


class InputsError(ValueError):
    """The record is damaged or not complete; the text says how."""


@dataclass(frozen=True, slots=True)
class ChunkInput:
    """A chunk: how many of the logged frames it held, and which others, each with the number of
    logged frames before it."""

    peer: Hashable
    arrived_s: float
    frames: int
    unlogged: tuple[tuple[int, bytes], ...] = ()


@dataclass(frozen=True, slots=True)
class TurnInput:
    """A turn: host time, chunks, and readings of the stopwatch."""

    now_s: float
    chunks: tuple[ChunkInput, ...]
    readings_s: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Call:
    """A call of the method `name` between two turns."""

    name: str
    arguments: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class OtherDatagrams:
    """The count of datagrams of other senders, before the next turn."""

    total: int


@dataclass(frozen=True, slots=True)
class FramesDropped:
    """So many frames at the end of the turn before were not sent."""

    count: int


@dataclass(frozen=True, slots=True)
class Check:
    """Checksum of the logged frames that were received since the check before."""

    crc: int


Entry = TurnInput | Call | OtherDatagrams | FramesDropped | Check


def entries(payloads: Iterable[bytes]) -> Iterator[Entry]:
    """The entries in the payloads of TUNNEL messages, in order. Ends within the last one if the log
    does. Raises InputsError where a piece is missing or damaged."""
    reader = _Reader(payloads)
    timed, now_us = True, 0
    peers: list[Hashable] = []
    while (kind := reader.kind()) is not None:
        try:
            if kind == _TURN:
                now_us += reader.signed() if timed else 0
                yield _turn(reader, timed, now_us, peers)
            elif kind == _CALL:
                name, *arguments = json.loads(reader.take(reader.number()))
                if name == SETTINGS:
                    timed = not arguments[0]["lockstep"]
                yield Call(str(name), tuple(arguments))
            elif kind == _PEER:
                peer = json.loads(reader.take(reader.number()))
                peers.append(tuple(peer) if isinstance(peer, list) else peer)
            elif kind == _OTHERS:
                yield OtherDatagrams(reader.number())
            elif kind == _DROPPED:
                yield FramesDropped(reader.number())
            elif kind == _CHECK:
                yield Check(int.from_bytes(reader.take(2), "little"))
            else:
                raise InputsError(f"unknown entry {kind}")
        except EOFError:
            return
        except (ValueError, LookupError, TypeError, OverflowError) as error:
            raise InputsError(str(error)) from None


def _turn(reader: _Reader, timed: bool, now_us: int, peers: list[Hashable]) -> TurnInput:
    chunks = tuple(_chunk(reader, timed, now_us, peers) for _ in range(reader.number()))
    return TurnInput(now_us / 1e6, chunks, _readings(reader, now_us) if timed else ())


def _chunk(reader: _Reader, timed: bool, now_us: int, peers: list[Hashable]) -> ChunkInput:
    peer = reader.number()
    arrived_us = now_us - reader.signed() if timed else 0
    frames = reader.number()
    others = reader.number() if peer & 1 else 0
    unlogged = tuple((reader.number(), reader.take(reader.number())) for _ in range(others))
    return ChunkInput(peers[peer >> 1], arrived_us / 1e6, frames, unlogged)


def _readings(reader: _Reader, now_us: int) -> tuple[float, ...]:
    readings: list[float] = []
    for _ in range(reader.number()):
        now_us += reader.signed()
        readings.append(now_us / 1e6)
    return tuple(readings)


class _Reader:
    """Bytes of the pieces, one after the other. Raises EOFError at their end."""

    def __init__(self, payloads: Iterable[bytes]) -> None:
        self._pieces = iter(payloads)
        self._count = 0
        self._data, self._at = b"", 0

    def kind(self) -> int | None:
        try:
            return self.take(1)[0]
        except EOFError:
            return None

    def take(self, size: int) -> bytes:
        while self._at + size > len(self._data):
            piece = next(self._pieces, None)
            if piece is None:
                raise EOFError
            if len(piece) < _HEAD.size or _HEAD.unpack_from(piece)[0] != self._count:
                raise InputsError(f"piece {self._count} is missing")
            self._count += 1
            self._data, self._at = self._data[self._at :] + piece[_HEAD.size :], 0
        self._at += size
        return self._data[self._at - size : self._at]

    def number(self) -> int:
        value = shift = 0
        while True:
            byte = self.take(1)[0]
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
            shift += 7

    def signed(self) -> int:
        value = self.number()
        return value >> 1 ^ -(value & 1)


def _varint(value: int) -> bytes:
    parts = bytearray()
    while value >= 0x80:
        parts.append(value & 0x7F | 0x80)
        value >>= 7
    parts.append(value)
    return bytes(parts)


def _zigzag(value: int) -> bytes:
    return _varint(value << 1 if value >= 0 else (-value << 1) - 1)
