"""A flight on the bundled simulator is the same to the byte: in this process and over UDP, on a
machine that is busy or idle."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Timer
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from offboard.analysis import tlog
from offboard.flight.flight import Flight
from offboard.flight.phases import Outcome, Phase
from offboard.flight.record import RECORD_ID, TickRecord
from offboard.link.stop import StopRequests
from offboard.mavlink.session import COMPONENT_ID, RECORD_COMPONENT_ID
from offboard.run import loop, sitl
from offboard.run.configuration import load
from offboard.run.flight import Simulated, fly
from offboard.run.sitl import InMemorySimulator, SimulatorProcess

VEHICLE_COMPONENT_ID = 1
WALL_TIMES = ("solve_time_s", "answer_s")  # fields of TickRecord that the machine decides
COLUMNS = [at for at, name in enumerate(TickRecord._fields) if name in WALL_TIMES]
SHORT = ("reference.duration_s=1", "reference.height_m=1", "identify.excite=false")
LATE = Simulated(scenario="delay_60ms")  # the first heartbeat comes after several barriers


def flown(
    directory: Path, simulated: Simulated, simulator: Any, **watched: Callable[[Any], None]
) -> Outcome:
    config = load(
        "flight", choices={"reference": "hover"}, assignments=SHORT, seed=3,
        known_vehicle=simulated.known_vehicle,
    )  # fmt: skip
    return fly(
        config, directory, simulated, simulator=simulator, stops=StopRequests(), **watched
    )  # fmt: skip


def frames(directory: Path) -> dict[int, list[bytes]]:
    """Frames of a log by component, without those of TIMESYNC, which a late side repeats."""
    found: dict[int, list[bytes]] = {}
    for entry in tlog.read(directory / "flight.tlog"):
        if entry.name != "TIMESYNC":
            found.setdefault(entry.component_id, []).append(without_wall_times(entry))
    return found


def without_wall_times(entry: tlog.LoggedMessage) -> bytes:
    """The frame; for the record of a tick, which is never sent, its fields without wall times."""
    if entry.name != "DEBUG_FLOAT_ARRAY" or entry.message.array_id != RECORD_ID:
        return entry.frame.raw
    kept = [value for at, value in enumerate(entry.message.data) if at not in COLUMNS]
    return repr((entry.frame.sequence, entry.message.time_usec, kept)).encode()


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[int, list[bytes]]:
    directory = tmp_path_factory.mktemp("undisturbed") / "flight"
    outcome = flown(directory, LATE, InMemorySimulator())
    assert (outcome.exit_code, outcome.sentence) == (0, "flown and landed")
    return frames(directory)


class LateSimulator(SimulatorProcess):
    """Starts each vehicle a tenth of a second after the launch."""

    def launch(self, options: Sequence[str]) -> None:
        super().launch(options)
        self.process.send_signal(signal.SIGSTOP)
        Timer(0.1, self.process.send_signal, (signal.SIGCONT,)).start()


def test_frames_are_identical_over_udp_with_stalls(
    undisturbed: dict[int, list[bytes]], tmp_path: Path
) -> None:
    """The simulator begins late. It repeats its first barrier, for which the controller is late,
    and one in flight, where the controller stalls."""
    stalls = [1.2]

    def progress(companion: Flight) -> None:
        if companion.phase is Phase.TRACK and stalls:
            time.sleep(stalls.pop())

    outcome = flown(tmp_path / "flight", LATE, LateSimulator(), progress=progress,
                    tell=lambda _: time.sleep(1.0))  # fmt: skip
    assert (outcome.exit_code, stalls) == (0, [])
    sent = frames(tmp_path / "flight")
    assert set(sent) == {VEHICLE_COMPONENT_ID, COMPONENT_ID, RECORD_COMPONENT_ID}
    assert len(sent[COMPONENT_ID]) > 100
    assert len(sent[VEHICLE_COMPONENT_ID]) > 1000
    for component, expected in undisturbed.items():
        assert sent[component] == expected


def divides(frames: object) -> list[tuple[int, bytes]]:
    raise ZeroDivisionError("division by zero")


@pytest.mark.parametrize(
    ("exchange", "says"),
    [
        (divides, "the bundled simulator failed (ZeroDivisionError: division by zero)"),
        (lambda frames: [], "the bundled simulator has not answered for 0."),
    ],
    ids=["fails", "hangs"],
)
def test_failing_or_hanging_simulator_ends_the_flight(
    exchange: Any, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load() -> Any:
        return lambda **options: SimpleNamespace(exchange=exchange)

    monkeypatch.setattr(sitl, "registered", lambda: SimpleNamespace(load=load))
    monkeypatch.setattr(loop, "SIMULATOR_S", 0.1)
    outcome = flown(tmp_path / "flight", Simulated(scenario="calm"), InMemorySimulator())
    assert outcome.exit_code == 3
    assert outcome.sentence.startswith(says)


LINK_LOST = {"fault": "link", "direction": "down", "loss": 1.0, "after": "engaged", "at_s": 8.0}
SILENT = "no telemetry for 1.0 s (limits.silence_s is 1); not heard for 300 s while landing; "


@pytest.mark.parametrize(
    ("fault", "code", "sentence"),
    [
        # the autopilot sends no telemetry after its restart until it is asked again
        ({"fault": "reboot", "at_s": 30.0}, 0, "flown and landed"),
        pytest.param(LINK_LOST, 4, SILENT, marks=pytest.mark.slow),
    ],
    ids=["restart on the ground", "telemetry lost"],
)
def test_lockstep_time_advances_without_telemetry(
    fault: dict[str, object], code: int, sentence: str, tmp_path: Path
) -> None:
    file = tmp_path / "faulty.yaml"
    file.write_text(yaml.safe_dump({"name": "faulty", "faults": [fault]}))
    outcome = flown(tmp_path / "flight", Simulated("ardupilot", str(file)), InMemorySimulator())
    assert outcome.exit_code == code
    assert outcome.sentence.startswith(sentence)
