"""Inputs of a flight in its log: its configuration, which vehicle it flew, and what its turns were
given, so that `offboard replay` can give it the same again. All are TUNNEL messages of our record
component.

The configuration is a text, compressed and in numbered pieces, the first entries of the log.

The log holds every frame that was received. What else a turn depends on is recorded here: its host
time, which frames arrived together, when and from whom, each reading of the stopwatch, and what the
loop requested. Host times are whole microseconds, rounded before the flight sees them, so that
the record is exact. In lockstep nothing depends on host time, and none is recorded.

The record is a list of JSON texts, one in a line, compressed by zlib and cut into TUNNEL messages
of that component: an object, or for a turn `[time, chunks, readings]` with the time since the
turn before, and in its chunks and readings since its own time.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

from offboard.link.interface import Chunk
from offboard.mavlink.events import VehicleFound
from offboard.mavlink.outgoing import ConfigurationRecord
from offboard.mavlink.session import Reception, SessionSettings

# TUNNEL.payload_type; numbers above 32767 need no registration
CONFIGURATION_TYPE, VEHICLE_TYPE, PAYLOAD_TYPE = 0xC0F1, 0xC0F3, 0xC0F5
_NUMBERED = struct.Struct("<HH")  # index of the piece, number of pieces of a configuration
_PART_BYTES = 128 - _NUMBERED.size
TEXT_MOST = 4_000_000  # bytes: eight of the longest configuration files; a log may be anybody's
_HEAD = struct.Struct("<I")  # number of the piece
_PIECE_BYTES = 128 - _HEAD.size
_CALL, _OTHERS, _DROPPED, _CHECK = "call", "others", "dropped", "crc"  # what an object holds
SETTINGS = "settings"  # the first call: how the session was set


# ---------------------------------------------------------------------- configuration and vehicle


def vehicle_record(vehicle: VehicleFound) -> ConfigurationRecord:
    """The record that says which vehicle is flown."""
    return ConfigurationRecord(json.dumps(asdict(vehicle)).encode(), VEHICLE_TYPE)


def vehicle_of(payload: bytes) -> VehicleFound | None:
    """The vehicle in the payload of such a record; None if it is damaged."""
    try:
        return VehicleFound(**json.loads(payload))
    except (ValueError, TypeError):
        return None


def pieces(text: str) -> list[ConfigurationRecord]:
    """Records that hold `text`, in order."""
    data = zlib.compress(text.encode("utf-8"), 9)
    parts = [data[at : at + _PART_BYTES] for at in range(0, len(data), _PART_BYTES)]
    return [
        ConfigurationRecord(_NUMBERED.pack(index, len(parts)) + part, CONFIGURATION_TYPE)
        for index, part in enumerate(parts)
    ]


def join(payloads: Iterable[bytes]) -> str | None:
    """The text in the payloads of TUNNEL messages; None if a piece is missing or damaged. Raises
    ValueError for a text of more than TEXT_MOST bytes."""
    parts: dict[int, bytes] = {}
    count = 0
    for payload in payloads:
        if len(payload) > _NUMBERED.size:
            index, count = _NUMBERED.unpack_from(payload)
            parts[index] = payload[_NUMBERED.size :]
        if len(parts) == count > 0:  # they are the first entries of a log
            break
    if not count or sorted(parts) != list(range(count)):
        return None
    unpacked = zlib.decompressobj()
    try:
        data = unpacked.decompress(b"".join(parts[index] for index in range(count)), TEXT_MOST)
        if unpacked.eof:
            return data.decode("utf-8")
    except (zlib.error, UnicodeDecodeError):
        return None
    if len(data) == TEXT_MOST:
        raise ValueError(f"its configuration unpacks to more than {TEXT_MOST // 1000} kB")
    return None


# ---------------------------------------------------------------------- turns


class InputRecorder:
    """Records the inputs of one `Flight`; see the module. With `kept` False nothing: a flight of
    a service goes on with what was known before, which its log does not hold."""

    def __init__(self, settings: SessionSettings, *, kept: bool = True) -> None:
        self._kept = kept
        self._timed = not settings.lockstep
        self._compressor = zlib.compressobj()
        self._data = bytearray()  # compressed, and not in a piece yet
        self._pieces = 0
        self._now_us = self._before_us = 0
        self._peers: list[Hashable] = []
        self._other_datagrams = 0
        self._chunks: list[list[Any]] = []  # of the turn in progress
        self._readings_us: list[int] = []
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
            self._write({_OTHERS: other_datagrams})
            self._other_datagrams = other_datagrams
        self._before_us, self._now_us = self._now_us, round(now_s * 1e6)
        self._chunks, self._readings_us = [], []
        return self._now_us / 1e6

    def arrived_s(self, chunk: Chunk) -> float:
        """The time of arrival of a chunk as it is recorded."""
        return round(chunk.arrived_s * 1e6) / 1e6

    def chunk(self, chunk: Chunk, reception: Reception) -> None:
        """A chunk of this turn, and what was found in it."""
        for frame in reception.frames:
            self._crc = zlib.crc32(frame, self._crc)
        unlogged = [(place, frame.hex()) for place, frame in reception.unlogged]
        arrived_us = round(chunk.arrived_s * 1e6) - self._now_us if self._timed else 0
        self._chunks.append([self._peer(chunk.peer), arrived_us, len(reception.frames), *unlogged])

    def watch(self, stopwatch: Callable[[], float]) -> Callable[[], float]:
        """The same stopwatch, whose readings are recorded."""

        def read() -> float:
            read_us = round(stopwatch() * 1e6)
            if self._timed:
                self._readings_us.append(read_us - self._now_us)
            return read_us / 1e6

        return read

    def end(self) -> None:
        """The turn ends. In lockstep one in which nothing arrived changes nothing."""
        if self._timed or self._chunks:
            step_us = self._now_us - self._before_us if self._timed else 0
            self._write([step_us, self._chunks, self._readings_us])

    def call(self, name: str, *arguments: object) -> None:
        """A method of the flight was called between two turns."""
        self._write({_CALL: [name, *arguments]})

    def dropped(self, frames: int) -> None:
        """The loop has not sent the last frames of the turn."""
        self._write({_DROPPED: frames})

    def pieces(self, *, all_of_it: bool) -> list[ConfigurationRecord]:
        """Records for the log: the full ones, or all that there is."""
        if not self._kept:
            return []
        if all_of_it:
            self._write({_CHECK: self._crc})
            self._crc = 0
            self._data += self._compressor.flush(zlib.Z_SYNC_FLUSH)
        records: list[ConfigurationRecord] = []
        while len(self._data) >= _PIECE_BYTES or (all_of_it and self._data):
            data = _HEAD.pack(self._pieces) + bytes(self._data[:_PIECE_BYTES])
            records.append(ConfigurationRecord(data, PAYLOAD_TYPE))
            self._pieces += 1
            del self._data[:_PIECE_BYTES]
        return records

    def _write(self, entry: object) -> None:
        if self._kept:
            line = json.dumps(entry, separators=(",", ":")) + "\n"
            self._data += self._compressor.compress(line.encode())

    def _peer(self, peer: Hashable) -> Hashable:
        """In lockstep its number: the simulator's port differs from run to run, and does not
        matter."""
        if self._timed:
            return peer
        if peer not in self._peers:
            self._peers.append(peer)
        return self._peers.index(peer)


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
    now_us = 0
    for line in _lines(payloads):
        try:
            found = json.loads(line)
            if isinstance(found, list):
                now_us += int(found[0])
                yield _turn(now_us, *found[1:])
            else:
                ((kind, value),) = found.items()
                yield _entry(kind, value)
        except (ValueError, LookupError, TypeError, OverflowError, RecursionError) as error:
            raise InputsError(f"damaged: {error}") from None


def _lines(payloads: Iterable[bytes]) -> Iterator[bytes]:
    unpacked, begun = zlib.decompressobj(), b""
    for count, piece in enumerate(payloads):
        if len(piece) < _HEAD.size or _HEAD.unpack_from(piece)[0] != count:
            raise InputsError(f"piece {count} is missing")
        try:
            *lines, begun = (begun + unpacked.decompress(piece[_HEAD.size :])).split(b"\n")
        except zlib.error as error:
            raise InputsError(f"piece {count} is damaged: {error}") from None
        if len(begun) > TEXT_MOST:
            raise InputsError(f"piece {count} is damaged: it has no end of line")
        yield from lines


def _turn(now_us: int, chunks: list[list[Any]], readings_us: list[int]) -> TurnInput:
    return TurnInput(
        now_us / 1e6,
        tuple(_chunk(now_us, *each) for each in chunks),
        tuple((now_us + each_us) / 1e6 for each_us in readings_us),
    )


def _entry(kind: str, value: Any) -> Entry:
    if kind == _CALL:
        name, *arguments = value
        return Call(str(name), tuple(arguments))
    kinds: dict[str, type[OtherDatagrams | FramesDropped | Check]]
    kinds = {_OTHERS: OtherDatagrams, _DROPPED: FramesDropped, _CHECK: Check}
    return kinds[kind](int(value))


def _chunk(
    now_us: int, peer: Any, arrived_us: int, frames: int, *unlogged: tuple[int, str]
) -> ChunkInput:
    sender: Hashable = tuple(peer) if isinstance(peer, list) else peer
    hash(sender)  # TypeError for what is no address
    return ChunkInput(
        sender,
        (now_us + arrived_us) / 1e6,
        int(frames),
        tuple((int(place), bytes.fromhex(frame)) for place, frame in unlogged),
    )
