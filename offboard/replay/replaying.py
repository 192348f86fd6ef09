"""Replays a flight: reads configuration, inputs of each turn and frames from a .tlog, creates the
`Flight` of the recording, and runs its turns with the recorded inputs.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from offboard.analysis import history, tlog
from offboard.analysis.tlog import LoggedMessage, Tlog
from offboard.documents.errors import UserError
from offboard.documents.signing_key import KEY_BYTES
from offboard.flight import record
from offboard.flight.flight import Flight
from offboard.flight.record import (
    CALL,
    CHECK,
    DROPPED,
    INPUTS_TYPE,
    OTHERS,
    Entry,
    InputsError,
    Note,
    TurnInput,
)
from offboard.link.interface import Chunk
from offboard.mavlink.framing import Frame, message_id_of, payload_of
from offboard.mavlink.session import COMPONENT_ID, RECORD_COMPONENT_ID, Session, SessionSettings
from offboard.mavlink.signing import Signing
from offboard.run.configuration import flown
from offboard.run.flight import Prepared, build

CALLS = ("request_stop", "announce", "note_autopilot", "guard")  # methods of `Flight` to replay


@dataclass(frozen=True, slots=True)
class Recording:
    """What a replay needs of a log. `settings` are the RECORDED_SETTINGS of the session, `inputs`
    the pieces of the recorded inputs (both in `flight.record`)."""

    log: Tlog
    configuration: str
    settings: dict[str, object]
    inputs: tuple[bytes, ...]

    @property
    def signed(self) -> bool:
        """Whether the link was signed; then the frames that we sent are signed, too."""
        return any(m.frame.signed for m in self.log if m.component_id == COMPONENT_ID)

    def entries(self) -> Iterator[Entry]:
        """Iterate over the inputs in order. Raises InputsError at the first damaged one."""
        return record.entries(self.inputs)


def read(flight: Path) -> Recording:
    """Read the recording of a flight directory or a .tlog file. Raises UserError."""
    path = tlog.find(flight)
    log = tlog.read(path)
    configuration = history.configuration(log)
    if configuration is None:
        raise UserError(
            f"{path} does not hold the configuration of a flight: only logs of offboard can be "
            "replayed"
        )
    recorded = tuple(m.tunnelled for m in log if m.record_type == INPUTS_TYPE)
    if not recorded:
        raise UserError(
            f"{path} cannot be replayed, only scored and reported: it has no inputs of each turn; "
            "a flight of `offboard daemon` goes on with what was received before its log begins"
        )
    return Recording(log, configuration, _settings(path, recorded), recorded)


def _settings(path: Path, recorded: tuple[bytes, ...]) -> dict[str, object]:
    try:
        first = next(record.entries(recorded), None)
    except InputsError as error:
        raise UserError(f"{path}: the record of the inputs is damaged: {error}") from None
    if not isinstance(first, Note) or first.values[0] != record.SETTINGS:
        raise UserError(f"{path}: the record of the inputs does not begin with the settings")
    return dict(first.values[1])


@dataclass(frozen=True, slots=True)
class Sent:
    """A frame that our component sent. `time_s` is the vehicle time of the newest telemetry before
    it; `turn` is the number of the turn that sent it, None for a frame of the log."""

    time_s: float
    message_id: int
    payload: bytes
    turn: int | None = None


Turn = tuple[TurnInput, list[LoggedMessage]]  # input of a turn, and the messages in its chunks


class Accepted(Signing):
    """Signing for a replay. It accepts every frame, because the log has no key, and only frames
    that were accepted in flight."""

    def refusal(self, frame: Frame, *, note: bool = True) -> None:
        return None


class Replay:
    """Replays one flight.

    `turns` runs all turns in order. `count` is the number of turns so far, `ended_s` the vehicle
    time of the newest telemetry that was replayed. `recorded` are the frames that were sent
    according to the log, `replayed` those of the replay. `stopped` says why the replay ended before
    the end of the recording; empty if it did not.
    """

    def __init__(self, recording: Recording) -> None:
        self.config = flown(recording.configuration)
        self.flight = self._new_flight(recording, build(self.config))
        self.recorded: list[Sent] = []
        self.replayed: list[Sent] = []
        self.stopped = ""
        self.ended_s = 0.0
        self.count = 0
        self.recording = recording
        self._messages = iter(recording.log)
        self._crc, self._checked_s = 0, 0.0
        self._readings: Iterator[float] = iter(())
        self._read_s = 0.0

    def _new_flight(self, recording: Recording, prepared: Prepared) -> Flight:
        settings: dict[str, Any] = recording.settings
        signing = Accepted(bytes(KEY_BYTES)) if recording.signed else None
        try:
            session = Session(SessionSettings(**settings), signing)
        except TypeError:
            raise UserError(
                f"{recording.log.path}: the settings of its session are those of another version"
            ) from None
        return prepared.flight(session, self._stopwatch)

    @property
    def incomplete(self) -> str:
        """A sentence that says up to when the recording was replayed, and why no further; empty if
        all of it was replayed."""
        if not self.stopped:
            return ""
        return f"replayed up to {self.ended_s:.1f} s of vehicle time: {self.stopped}"

    def turns(self) -> Iterator[Turn]:
        """Replay the flight turn by turn."""
        try:
            for entry in self.recording.entries():
                match entry:
                    case TurnInput():
                        turn = self._turn(entry)
                        if turn is None:
                            break
                        yield turn
                    case Note(kind, values):
                        self._obey(kind, *values)
        except InputsError as error:
            self.stopped = str(error)
        self._drain()
        if self.stopped or not self.flight.has_ended():
            self._cut()

    def _obey(self, kind: str, value: Any, *arguments: Any) -> None:
        """Replay an entry between two turns."""
        if kind == DROPPED:
            del self.replayed[len(self.replayed) - value :]  # the newest turn has encoded them
            self.flight.on_dropped(value)
        elif kind == OTHERS:
            self.flight.other_datagrams = value
        elif kind == CALL and value in CALLS:
            getattr(self.flight, value)(*arguments)
        elif kind == CHECK:
            if value != self._crc:
                raise InputsError("received frames are missing or damaged")
            self._crc, self._checked_s = 0, self.ended_s

    # ------------------------------------------------------------------ one turn

    def _turn(self, given: TurnInput) -> Turn | None:
        chunks: list[Chunk] = []
        received: list[LoggedMessage] = []
        for chunk in given.chunks:
            messages = self._take(chunk.frames)
            if messages is None:
                return None
            parts = [message.frame.raw for message in messages]
            for frame in parts:
                self._crc = zlib.crc32(frame, self._crc)
            for place, frame in reversed(chunk.unlogged):
                parts.insert(place, frame)
            chunks.append(Chunk(b"".join(parts), chunk.peer, chunk.arrived_s))
            received += messages
        self._readings, self._read_s = iter(given.readings_s), given.now_s
        self.count += 1
        frames = self._frames(chunks, given.now_s)
        self.ended_s = self.flight.time_s
        if frames is not None:
            self.replayed += map(self._sent, frames)
            self.flight.finish_turn(math.nan)  # a replay sends nothing, at no time
        return given, received

    def _frames(self, chunks: list[Chunk], now_s: float) -> tuple[bytes, ...] | None:
        try:
            return self.flight.turn(chunks, now_s)
        except (Exception, SystemExit):  # the loop did the same, and then requested the landing
            return None

    def _stopwatch(self) -> float:
        """Return the next recorded reading; after the last one, always the same."""
        self._read_s = next(self._readings, self._read_s)
        return self._read_s

    def _sent(self, frame: bytes) -> Sent:
        kind, payload = message_id_of(frame), payload_of(frame)
        return Sent(self.flight.time_s, kind, payload, self.count)

    # ------------------------------------------------------------------ the log

    def _take(self, count: int) -> list[LoggedMessage] | None:
        """Return the next `count` received messages; None if the log ends before."""
        taken: list[LoggedMessage] = []
        while len(taken) < count:
            message = next(self._messages, None)
            if message is None:
                return None
            if not self._note(message):
                taken.append(message)
        return taken

    def _note(self, message: LoggedMessage) -> bool:
        """Store a message of the log if we sent it. Return whether it is one of ours."""
        if message.system_id != self.flight.session.senders.own.system_id:
            return False
        if message.component_id == RECORD_COMPONENT_ID:
            return True
        if message.component_id != COMPONENT_ID:
            return False
        frame = message.frame
        self.recorded.append(Sent(self.ended_s, frame.message_id, frame.payload))
        self._note_thrust(message)
        return True

    def _note_thrust(self, message: LoggedMessage) -> None:
        """Store the thrust of a recorded setpoint: the vehicle reports this thrust in the recorded
        telemetry, whatever the replay sends."""
        thrusts = self.flight.thrusts
        if message.name == "SET_ATTITUDE_TARGET":
            thrusts.append(message.message.thrust)
        elif message.name.startswith("SET_POSITION_TARGET"):
            thrusts.clear()

    def _drain(self) -> None:
        """Store the messages in the log that the last turns sent."""
        for message in self._messages:
            if not self._note(message):
                return

    def _cut(self) -> None:
        """Keep only messages before the newest valid checksum, because the log is not complete."""
        for sent in (self.recorded, self.replayed):
            sent[:] = [each for each in sent if each.time_s < self._checked_s]
