"""The corpus: small recorded flights, and what the present code must send in them.

recordings/NAME.tlog.xz is a flight, of which a replay needs telemetry, the inputs of each turn, and
the setpoints and commands as flown. recordings/NAME.sent has the expected setpoints and commands,
one per line: vehicle time in s, message id, payload. `python tests/replay/corpus.py FLIGHT NAME`
adds one.
"""

from __future__ import annotations

import lzma
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from offboard.mavlink.framing import SETPOINTS
from offboard.mavlink.senders import COMMANDS
from offboard.replay.replaying import Recording, Replay, Sent, read

FLIGHTS = Path(__file__).parent / "recordings"
COMPARED = frozenset((*SETPOINTS, *COMMANDS))


@contextmanager
def unpacked(name: str) -> Iterator[Recording]:
    """Yield the recording of a flight of the corpus."""
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / f"{name}.tlog"
        path.write_bytes(lzma.decompress((FLIGHTS / f"{name}.tlog.xz").read_bytes()))
        yield read(path)


def names() -> list[str]:
    return sorted(path.name.removesuffix(".tlog.xz") for path in FLIGHTS.glob("*.tlog.xz"))


def replayed(recording: Recording) -> Replay:
    """Replay a flight to its end."""
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
    """Add the log of a flight to the corpus; what it sent is expected."""
    recording = read(flight)
    replay = replayed(recording)
    packed = lzma.compress(recording.log.path.read_bytes(), preset=9 | lzma.PRESET_EXTREME)
    (FLIGHTS / f"{name}.tlog.xz").write_bytes(packed)
    write_expected(name, replay.recorded)
    print(f"{name}: {len(packed)} bytes, {len(replay.recorded)} frames sent")


if __name__ == "__main__":
    add(Path(sys.argv[1]), sys.argv[2])
