"""The simulator in this process: the same flight as over UDP, byte for byte."""

from __future__ import annotations

from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from offboard.flight.flight import Outcome
from offboard.link.stop import StopRequests
from offboard.run import flight, sitl
from offboard.run.configuration import load
from offboard.run.flight import Simulated, fly
from offboard.run.sitl import InMemoryLink, InMemorySimulator, SimulatorProcess

HEARTBEAT, SETPOINT, TELEMETRY = 0, 82, (30, 31, 32, 115)
SHORT = ("reference.duration_s=1", "reference.height_m=1", "identify.excite=false")


def frames(log: Path, *kinds: int) -> list[bytes]:
    """The frames of a .tlog with these message ids."""
    data, at, found = log.read_bytes(), 0, []
    while at < len(data):
        frame = data[at + 8 : at + 20 + data[at + 9]]
        if int.from_bytes(frame[7:10], "little") in kinds:
            found.append(frame)
        at += 8 + len(frame)
    return found


def flown(
    directory: Path, simulated: Simulated, simulator: SimulatorProcess | InMemorySimulator
) -> Outcome:
    config = load(
        "flight", choices={"controller": "lqr", "reference": "hover"}, assignments=SHORT, seed=3,
        known_vehicle=simulated.known_vehicle,
    )  # fmt: skip
    return fly(config, directory, simulated, simulator=simulator, stops=StopRequests())


def test_a_flight_in_memory_is_that_over_udp(tmp_path: Path) -> None:
    """With a late link, the first heartbeat comes after several barriers."""
    sent = {}
    with SimulatorProcess() as process:
        for name, vehicle in (("memory", InMemorySimulator()), ("udp", process)):
            outcome = flown(tmp_path / name, Simulated(scenario="delay_60ms"), vehicle)
            assert (outcome.exit_code, outcome.sentence) == (0, "flown and landed")
            log = tmp_path / name / "flight.tlog"
            sent[name] = frames(log, SETPOINT), frames(log, *TELEMETRY)
    assert len(sent["udp"][0]) > 60
    assert len(sent["udp"][1]) > 1000
    assert sent["memory"] == sent["udp"]


class Idle(InMemorySimulator):
    """Every third turn finds nothing, as where the simulator is slower than the loop."""

    def open_link(self, **options: Any) -> InMemoryLink:
        link = super().open_link(**options)
        receive, turns = link.receive, count()
        link.receive = lambda timeout_s: receive(timeout_s) if next(turns) % 3 else []  # type: ignore[method-assign]
        return link


def test_turns_that_receive_nothing_change_no_byte_of_a_flight(tmp_path: Path) -> None:
    sent = []
    for name, vehicle in (("busy", InMemorySimulator()), ("idle", Idle())):
        assert flown(tmp_path / name, Simulated(scenario="calm"), vehicle).exit_code == 0
        sent.append(frames(tmp_path / name / "flight.tlog", HEARTBEAT, SETPOINT, *TELEMETRY))
    assert len(sent[0]) > 1000
    assert sent[0] == sent[1]


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
def test_a_vehicle_that_fails_or_hangs_ends_the_flight_with_a_sentence(
    exchange: Any, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load() -> Any:
        return lambda **options: SimpleNamespace(exchange=exchange)

    monkeypatch.setattr(sitl, "registered", lambda: SimpleNamespace(load=load))
    monkeypatch.setattr(flight, "SITL_TIMEOUT_S", 0.1)
    outcome = flown(tmp_path / "flight", Simulated(scenario="calm"), InMemorySimulator())
    assert outcome.exit_code == 3
    assert outcome.sentence.startswith(says)


LINK_LOST = {"fault": "link", "direction": "down", "loss": 1.0, "after": "engaged", "at_s": 8.0}


@pytest.mark.parametrize(
    ("fault", "code", "sentence"),
    [
        # the autopilot sends no telemetry after its restart until it is asked again
        ({"fault": "reboot", "at_s": 30.0}, 0, "flown and landed"),
        pytest.param(
            LINK_LOST, 4, "no telemetry for 1.0 s; not heard for 300 s while landing; last known: ",
            marks=pytest.mark.slow,
        ),
    ],
    ids=["restart on the ground", "telemetry lost"],
)  # fmt: skip
def test_time_goes_on_without_telemetry(
    fault: dict[str, object], code: int, sentence: str, tmp_path: Path
) -> None:
    file = tmp_path / "faulty.yaml"
    file.write_text(yaml.safe_dump({"name": "faulty", "faults": [fault]}))
    outcome = flown(tmp_path / "flight", Simulated("ardupilot", str(file)), InMemorySimulator())
    assert outcome.exit_code == code
    assert outcome.sentence.startswith(sentence)
