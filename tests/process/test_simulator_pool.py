"""The bundled simulator's process: it flies one vehicle after another and ends each of them."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from processes import children, ended, eventually

from offboard.analysis import tlog
from offboard.flight.flight import Flight
from offboard.flight.phases import Phase
from offboard.run.configuration import load
from offboard.run.flight import Simulated, fly
from offboard.run.sitl import Ending, SimulatorProcess

KILLED = Ending("the bundled simulator ended (signal 9)", unusable=False)
SHORT = ("reference.height_m=1", "identify.excite=false")


@contextmanager
def flying(simulator: SimulatorProcess) -> Iterator[int]:
    """A vehicle in lockstep that has sent something: its process id."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours:
        ours.bind(("127.0.0.1", 0))
        ours.settimeout(30.0)
        port = ours.getsockname()[1]
        simulator.launch(["--connect", f"udpout:127.0.0.1:{port}", "--gcs", "none", "--lockstep"])
        assert ours.recv(65535)
        (vehicle,) = children(simulator.process.pid)
        yield vehicle


def test_how_each_vehicle_ends_is_reported_and_the_next_one_flies() -> None:
    with SimulatorProcess() as simulator:
        pid = simulator.process.pid
        for options, says in (
            (["--scenario", "storm"], "there is no scenario named 'storm'; known are"),
            (["--firmware", "betaflight"], "--firmware betaflight: unknown"),
        ):
            simulator.launch(options)
            ending = simulator.ending(10.0)
            assert ending is not None
            assert (ending.unusable, ending.sentence.startswith(says)) == (True, True)
            with flying(simulator) as vehicle:
                os.kill(vehicle, signal.SIGKILL)
                assert simulator.ending(10.0) == KILLED  # not the words before
        with flying(simulator):
            assert simulator.ending() is None
        simulator.recall()
        assert (children(simulator.process.pid), simulator.process.pid) == ([], pid)


def test_one_that_dies_in_flight_ends_it_and_is_replaced(tmp_path: Path) -> None:
    lost: list[int] = []

    def kill(companion: Flight) -> None:
        if companion.phase is Phase.TRACK and not lost:
            lost.extend((*children(simulator.process.pid), simulator.process.pid))
            os.kill(simulator.process.pid, signal.SIGKILL)

    config = load("flight", choices={"reference": "hover"}, assignments=SHORT)
    with SimulatorProcess() as simulator:
        outcome = fly(
            config, tmp_path / "x", Simulated(scenario="calm"), simulator=simulator, progress=kill
        )
        assert (outcome.exit_code, outcome.sentence) == (4, KILLED.sentence)
        log = tlog.read(tmp_path / "x" / "flight.tlog")
        assert sum(entry.name == "SET_ATTITUDE_TARGET" for entry in log) > 50
        orphan, pool = lost
        eventually(lambda: ended(orphan))
        with flying(simulator):
            assert simulator.process.pid != pool
    assert ended(simulator.process.pid)
