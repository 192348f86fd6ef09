"""The corpus: small recorded flights, and what the present code answers to them.

A flight is recordings/NAME.tlog.xz: telemetry, the inputs of each turn, and the setpoints and
commands as flown. recordings/NAME.sent has those that are expected, one in a line: vehicle time in
s, message id, payload. `python tests/replay/corpus.py FLIGHT NAME` adds a flight.
"""

from __future__ import annotations

import lzma
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

from offboard.analysis.history import record_type
from offboard.analysis.tlog import LoggedMessage
from offboard.flight.record import (
    CALL,
    CHECK,
    OTHERS,
    InputRecorder,
    Note,
    TurnInput,
)
from offboard.flight.record import CONFIGURATION_TYPE as MANIFEST
from offboard.link.interface import Chunk
from offboard.link.log import entry
from offboard.mavlink.framing import SETPOINTS
from offboard.mavlink.outgoing import ConfigurationRecord
from offboard.mavlink.senders import COMMANDS
from offboard.mavlink.session import RECORD_COMPONENT_ID, Reception, SessionSettings
from offboard.replay.replaying import CALLS, Recording, Replay, Sent, read

FLIGHTS = Path(__file__).parent / "recordings"
# Messages that the session decodes or whose rate it counts; the others only fill the log
USED = frozenset(
    (0, 1, 22, 24, 31, 32, 49, 77, 83, 108, 111, 115, 193, 230, 242, 245, 253, 436, *SETPOINTS)
)
COMPARED = frozenset((*SETPOINTS, *COMMANDS))


@contextmanager
def unpacked(name: str) -> Iterator[Recording]:
    """The recording of a flight of the corpus."""
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / f"{name}.tlog"
        path.write_bytes(lzma.decompress((FLIGHTS / f"{name}.tlog.xz").read_bytes()))
        yield read(path)


def names() -> list[str]:
    return sorted(path.name.removesuffix(".tlog.xz") for path in FLIGHTS.glob("*.tlog.xz"))


def replayed(recording: Recording) -> Replay:
    """The flight, replayed to its end."""
    replay = Replay(recording)
    for _ in replay.turns():
        pass
    return replay


# ------------------------------------------------------------------ what is expected


def expected(name: str) -> list[Sent]:
    lines = (FLIGHTS / f"{name}.sent").read_text().splitlines()
    rows = (line.split() for line in lines)
    return [Sent(float(time_s), int(kind), bytes.fromhex(data)) for time_s, kind, data in rows]


def write_expected(name: str, sent: Iterable[Sent]) -> None:
    (FLIGHTS / f"{name}.sent").write_text(
        "".join(
            f"{each.time_s!r} {each.message_id} {each.payload.hex()}\n"
            for each in sent
            if each.message_id in COMPARED
        )
    )


# ------------------------------------------------------------------ a new flight


def add(flight: Path, name: str) -> None:
    """Keep what a replay needs of a flight, compressed."""
    recording = read(flight)
    replay = Replay(recording)
    turns = {number: received for number, (_, received) in enumerate(replay.turns(), 1)}
    packed = lzma.compress(thinned(recording, turns), preset=9 | lzma.PRESET_EXTREME)
    (FLIGHTS / f"{name}.tlog.xz").write_bytes(packed)
    write_expected(name, replay.recorded)
    print(f"{name}: {len(packed)} bytes, {len(replay.recorded)} frames sent")


def thinned(recording: Recording, turns: dict[int, list[LoggedMessage]]) -> bytes:
    """A log with the configuration, the messages that are used or compared, and the inputs."""
    received = {message.frame.raw for turn in turns.values() for message in turn}
    kept: list[bytes] = []
    for message in recording.log:
        kinds = USED if message.frame.raw in received else COMPARED
        if message.frame.message_id in kinds or record_type(message) == MANIFEST:
            kept.append(entry(message.unix_us, message.frame.raw))
    records = inputs_of(recording, turns)
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=RECORD_COMPONENT_ID)
    frames = (bytes(record.encode(None).pack(sender)) for record in records)
    return b"".join([*kept, *(entry(message.unix_us, frame) for frame in frames)])


def inputs_of(
    recording: Recording, turns: dict[int, list[LoggedMessage]]
) -> list[ConfigurationRecord]:
    """The inputs as recorded, for the messages that are kept."""
    recorder = InputRecorder(SessionSettings(**recording.settings))  # type: ignore[arg-type]
    number, other_datagrams = 0, 0
    reading = 0.0
    read_again = recorder.watch(lambda: reading)
    for each in recording.entries():
        match each:
            case TurnInput(now_s, chunks, readings_s):
                number += 1
                messages = iter(turns[number])
                recorder.begin(now_s, other_datagrams)
                for chunk in chunks:
                    frames = [next(messages).frame for _ in range(chunk.frames)]
                    used = [frame.message_id in USED for frame in frames]
                    unlogged = tuple((sum(used[:at]), raw) for at, raw in chunk.unlogged)
                    raws = tuple(f.raw for f, keep in zip(frames, used, strict=True) if keep)
                    arrived = Chunk(b"", chunk.peer, chunk.arrived_s)
                    recorder.chunk(arrived, Reception(raws, unlogged=unlogged))
                for reading in readings_s:  # noqa: B007 - `read_again` reads it
                    read_again()
                recorder.end()
            case Note(kind, values) if kind == OTHERS:
                (other_datagrams,) = values
            case Note(kind, values) if kind == CALL:
                if values[0] in CALLS:
                    recorder.call(*values)
            case Note(kind, (value,)) if kind != CHECK:
                recorder.note(kind, value)
    return recorder.pieces(all_of_it=True)


if __name__ == "__main__":
    add(Path(sys.argv[1]), sys.argv[2])
