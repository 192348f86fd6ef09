"""Records in the log of a flight, beside the frames that were received and sent: each control tick,
what was identified, the configuration, the vehicle, and the inputs of each turn, from which
`offboard replay` repeats the flight.

A tick is a DEBUG_FLOAT_ARRAY (name "pso"; array_id: the number of fields) whose data are the fields
of `TickRecord`; the analysis reads the log with the same class. What was identified is another
DEBUG_FLOAT_ARRAY.

The other records here are TUNNEL messages of our record component. The configuration is a
compressed text in numbered pieces, the first entries of the log. The inputs (README.md) are lines
of JSON, compressed by zlib and cut into pieces. A line is an object, or for a turn the list
`[time, chunks, readings]`, in whole microseconds: `time` since the turn before, and the times in
`chunks` and `readings` relative to the turn.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from enum import IntFlag
from typing import Any, NamedTuple

from offboard.control.base import Certificate, Decision
from offboard.flight.phases import Phase
from offboard.identification.uncertainty import Estimate
from offboard.link.interface import Chunk
from offboard.mavlink.event_record import numbered
from offboard.mavlink.events import VehicleFound
from offboard.mavlink.outgoing import PIECE_BYTES, ConfigurationRecord, SolverRecord
from offboard.mavlink.session import Reception, SessionSettings
from offboard.model.command import Command, PositionCommand, PredictedState

RECORD_NAME = "pso"
CERTIFIED = len(fields(Certificate))
IDENTIFIED_NAME, IDENTIFIED_ID = "identified", 2  # of the other DEBUG_FLOAT_ARRAY in the log
IDENTIFIED = (  # value and standard deviation of each, in this order
    *("tilt_delay_s", "tilt_natural_frequency_radps", "tilt_damping"),
    *("yaw_delay_s", "yaw_natural_frequency_radps", "yaw_damping"),
    *("hover_thrust", "thrust_lag_s", "thrust_delay_s", "drag_ps"),
)
# Beginning of the text about a decision that raised an error. There is no record of such a tick, so
# the analysis counts these texts
DECISION_FAILED = "decision failed: "


class Refusal(IntFlag):
    """Why a setpoint was not sent; the numbers are those in the log."""

    LATE = 1  # decided after its deadline
    STALE = 2  # the telemetry that it was made for is too old
    NOT_OURS = 4  # the vehicle does not follow us, or it is not known whether it does
    UNUSABLE = 8  # a value is not finite, or MAVLink cannot hold it


class TickRecord(NamedTuple):
    """One control tick: floats in SI, NED and vehicle time; NaN for what the law does not provide.

    Thrust, direction and heading are those of the setpoint that was sent. The certificate, from
    `cost` to `at_bound` and `seed_cost`, belongs to this setpoint too. It is NaN if the control law
    certified another one, because excitation or the limits changed it, or if none was sent.
    """

    phase: float  # of flight.phases.Phase
    thrust_mps2: float
    thrust_direction_north: float
    thrust_direction_east: float
    thrust_direction_down: float
    heading_rad: float
    cost: float
    optimal_cost: float
    gap: float
    spread: float
    iterations: float
    cut_short: float
    at_bound: float
    solve_time_s: float
    answer_s: float  # host time from the arrival of the telemetry until the setpoint was sent
    missed_ticks: float  # ticks skipped since the previous record
    predicted_north_m: float
    predicted_east_m: float
    predicted_down_m: float
    predicted_velocity_north_mps: float
    predicted_velocity_east_mps: float
    predicted_velocity_down_mps: float
    disturbance_north_mps2: float
    disturbance_east_mps2: float
    disturbance_down_mps2: float
    hover_thrust: float
    track_time_s: float  # time since the start of the track; NaN before it
    seed_cost: float  # cost of the best plan that the search started from
    age_s: float  # of the telemetry when the setpoint was sent, vehicle time
    refused: float  # flags of `Refusal`; 0 for a setpoint that was sent
    other_datagrams: float  # of other senders, and forged frames, since the last record
    pause_s: float  # longest pause of this process since the previous tick; 0 if below a period


FIELDS = TickRecord._fields
RECORD_ID = len(FIELDS)


@dataclass(slots=True)
class Decided:
    """A decision, the predicted state it was made for, and whether it was sent."""

    phase: Phase
    state: PredictedState
    decision: Decision
    solve_time_s: float
    sent: Command | PositionCommand | None = None
    age_s: float = 0.0  # of its telemetry, when it was checked
    refused: int = 0  # flags of `Refusal`
    failure: str = ""  # why it was refused


def identified_record(time_s: float, found: Mapping[str, Estimate | None]) -> SolverRecord:
    """DEBUG_FLOAT_ARRAY with value and standard deviation of each constant of IDENTIFIED, in the
    units of their names; NaN for what was not identified. `time_s`: vehicle time."""
    numbers: list[float] = []
    for each in map(found.__getitem__, IDENTIFIED):
        numbers += (each.value, each.sd) if each else (math.nan, math.nan)
    return SolverRecord(time_s, tuple(numbers), IDENTIFIED_ID, IDENTIFIED_NAME)


# ---------------------------------------------------------------------- configuration and vehicle

# TUNNEL.payload_type; numbers above 32767 need no registration
CONFIGURATION_TYPE, VEHICLE_TYPE, INPUTS_TYPE = 0xC0F1, 0xC0F3, 0xC0F5
_NUMBERED = struct.Struct("<HH")  # index of the piece, number of pieces of a configuration
TEXT_MOST = 4_000_000  # bytes, eight times the longest configuration: a log may be hostile
_HEAD = struct.Struct("<I")  # number of the piece of the inputs
_PIECE_BYTES = PIECE_BYTES - _HEAD.size
# Keys of an object: name and arguments of a call of the flight; total number of datagrams of
# others; number of frames that were not sent; checksum of the received frames
CALL, OTHERS, DROPPED, CHECK = "call", "others", "dropped", "crc"
SETTINGS = "settings"  # the first call: the settings of the session
RECORDED_SETTINGS = ("system_id", "lockstep", "stream", "sends_first", "capacity_bytes_ps")


def vehicle_record(vehicle: VehicleFound) -> ConfigurationRecord:
    """Return the record that says which vehicle is flown."""
    return ConfigurationRecord(json.dumps(asdict(vehicle)).encode(), VEHICLE_TYPE)


def vehicle_of(payload: bytes) -> VehicleFound | None:
    """Return the vehicle in the payload of a `vehicle_record`; None if it is damaged."""
    try:
        return VehicleFound(**json.loads(payload))
    except (ValueError, TypeError):
        return None


def configuration_pieces(text: str) -> list[ConfigurationRecord]:
    """Return the records that hold `text`, in order."""
    return numbered(zlib.compress(text.encode("utf-8"), 9), _NUMBERED, CONFIGURATION_TYPE)


def joined_configuration(payloads: Iterable[bytes]) -> str | None:
    """Return the text in the payloads of TUNNEL messages, or None if a piece is missing or damaged.
    Raises ValueError for a text of more than TEXT_MOST bytes."""
    parts: dict[int, bytes] = {}
    count = 0
    for payload in payloads:
        if len(payload) > _NUMBERED.size:
            index, count = _NUMBERED.unpack_from(payload)
            parts[index] = payload[_NUMBERED.size :]
        if len(parts) == count > 0:  # complete: its pieces are the first entries of a log
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
    """Records the inputs of one `Flight`; see the module. With `kept` False it records nothing."""

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
        self.call(SETTINGS, {name: getattr(settings, name) for name in RECORDED_SETTINGS})

    def begin(self, now_s: float, other_datagrams: int) -> float:
        """Begin a turn. Returns its host time as recorded, rounded to microseconds."""
        if other_datagrams != self._other_datagrams:
            self.note(OTHERS, other_datagrams)
            self._other_datagrams = other_datagrams
        self._before_us, self._now_us = self._now_us, round(now_s * 1e6)
        self._chunks, self._readings_us = [], []
        return self._now_us / 1e6

    def arrived_s(self, chunk: Chunk) -> float:
        """Return the time of arrival of a chunk as recorded, rounded to microseconds."""
        return round(chunk.arrived_s * 1e6) / 1e6

    def chunk(self, chunk: Chunk, reception: Reception) -> None:
        """Record a chunk of this turn, and what was found in it."""
        for frame in reception.frames:
            self._crc = zlib.crc32(frame, self._crc)
        unlogged = [(place, frame.hex()) for place, frame in reception.unlogged]
        arrived_us = round(chunk.arrived_s * 1e6) - self._now_us if self._timed else 0
        self._chunks.append([self._peer(chunk.peer), arrived_us, len(reception.frames), *unlogged])

    def watch(self, stopwatch: Callable[[], float]) -> Callable[[], float]:
        """Return the same stopwatch with readings that are recorded."""

        def read() -> float:
            read_us = round(stopwatch() * 1e6)
            if self._timed:
                self._readings_us.append(read_us - self._now_us)
            return read_us / 1e6

        return read

    def end(self) -> None:
        """End the turn. In lockstep, a turn in which nothing arrived changes nothing and is not
        recorded."""
        if self._timed or self._chunks:
            step_us = self._now_us - self._before_us if self._timed else 0
            self._write([step_us, self._chunks, self._readings_us])

    def call(self, name: str, *arguments: object) -> None:
        """Record that a method of the flight was called between two turns."""
        self.note(CALL, [name, *arguments])

    def note(self, kind: str, value: object) -> None:
        """Record something beside the turns: one of CALL, OTHERS, DROPPED, CHECK."""
        self._write({kind: value})

    def pieces(self, *, all_of_it: bool) -> list[ConfigurationRecord]:
        """Return records for the log: the full pieces, or with `all_of_it` everything so far."""
        if not self._kept:
            return []
        if all_of_it:
            self.note(CHECK, self._crc)
            self._crc = 0
            self._data += self._compressor.flush(zlib.Z_SYNC_FLUSH)
        records: list[ConfigurationRecord] = []
        while len(self._data) >= _PIECE_BYTES or (all_of_it and self._data):
            data = _HEAD.pack(self._pieces) + bytes(self._data[:_PIECE_BYTES])
            records.append(ConfigurationRecord(data, INPUTS_TYPE))
            self._pieces += 1
            del self._data[:_PIECE_BYTES]
        return records

    def _write(self, entry: object) -> None:
        if self._kept:
            line = json.dumps(entry, separators=(",", ":")) + "\n"
            self._data += self._compressor.compress(line.encode())

    def _peer(self, peer: Hashable) -> Hashable:
        """Return the address as recorded: in lockstep a number, because the simulator's port
        differs from run to run."""
        if self._timed:
            return peer
        if peer not in self._peers:
            self._peers.append(peer)
        return self._peers.index(peer)


class InputsError(ValueError):
    """The record of the inputs is damaged or not complete; the message says how."""


@dataclass(frozen=True, slots=True)
class ChunkInput:
    """A chunk: `frames` is the number of logged frames in it, `unlogged` are its other frames, each
    with the number of logged frames before it."""

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
class Note:
    """An entry beside the turns, see `InputRecorder.note`. `values` are the name of the method and
    its arguments for a CALL, and one number for the others."""

    kind: str
    values: tuple[Any, ...]


Entry = TurnInput | Note


def entries(payloads: Iterable[bytes]) -> Iterator[Entry]:
    """Yield the entries in the payloads of TUNNEL messages, in order. An entry that the end of the
    log cuts off is left out. Raises InputsError where a piece is missing or damaged."""
    now_us = 0
    for line in _lines(payloads):
        try:
            found = json.loads(line)
            if isinstance(found, list):
                now_us += int(found[0])
                yield _turn(now_us, *found[1:])
            else:
                ((kind, value),) = found.items()
                yield Note(kind, (str(value[0]), *value[1:]) if kind == CALL else (int(value),))
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
