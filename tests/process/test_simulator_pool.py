"""The bundled simulator's process: it flies one vehicle after another and ends each of them."""

from __future__ import annotations

import os
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from processes import children

from offboard.run.sitl import SimulatorProcess

HELLO = 65535


@pytest.fixture(scope="module")
def simulator() -> Iterator[SimulatorProcess]:
    with SimulatorProcess() as simulator:
        yield simulator


@contextmanager
def flying(simulator: SimulatorProcess, *options: str) -> Iterator[bytes]:
    """A vehicle in lockstep, and the first datagram that it sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours:
        ours.bind(("127.0.0.1", 0))
        ours.settimeout(30.0)
        port = ours.getsockname()[1]
        simulator.launch(
            ["--connect", f"udpout:127.0.0.1:{port}", "--gcs", "none", "--lockstep", *options]
        )
        yield ours.recv(HELLO)


def vehicles(simulator: SimulatorProcess) -> list[int]:
    return children(simulator.pid)


def gone(pid: int) -> bool:
    """Whether a process that is no child of ours ends within ten seconds."""
    for _ in range(1000):
        if not Path(f"/proc/{pid}/exe").exists():
            return True
        time.sleep(0.01)
    return False


def test_vehicles_with_the_same_seed_send_the_same_datagram(simulator: SimulatorProcess) -> None:
    hellos, pid = [], simulator.pid
    for seed in ("1", "1", "2"):
        with flying(simulator, "--scenario", "px4_like", "--seed", seed) as hello:
            hellos.append(hello)
            assert len(vehicles(simulator)) == 1
            assert simulator.ended() is None
        simulator.recall()
        assert (vehicles(simulator), simulator.pid) == ([], pid)
    assert hellos[0] == hellos[1] != hellos[2]


def test_the_end_of_a_vehicle_is_reported_and_the_next_one_flies(
    simulator: SimulatorProcess,
) -> None:
    with flying(simulator):
        os.kill(vehicles(simulator)[0], signal.SIGKILL)
        ending = simulator.ended(10.0)
        assert ending is not None
        assert (ending.sentence, ending.unusable) == (
            "the bundled simulator ended (signal 9)",
            False,
        )
    simulator.recall()
    with flying(simulator):
        assert simulator.ended() is None
    simulator.recall()


def test_wrong_options_are_reported_as_the_simulator_does(simulator: SimulatorProcess) -> None:
    simulator.launch(["--scenario", "storm"])
    ending = simulator.ended(10.0)
    assert ending is not None
    assert ending.unusable
    assert ending.sentence.startswith("there is no scenario named 'storm'; known are")
    simulator.launch(["--firmware", "betaflight"])
    again = simulator.ended(10.0)
    assert again is not None
    assert again.sentence.startswith("--firmware betaflight: unknown")
    with flying(simulator):
        os.kill(vehicles(simulator)[0], signal.SIGKILL)
        last = simulator.ended(10.0)
        assert last is not None
        assert last.sentence == "the bundled simulator ended (signal 9)"  # not the words before


def test_a_pool_that_was_lost_is_replaced() -> None:
    with SimulatorProcess() as simulator:
        with flying(simulator):
            lost, (orphan,) = simulator.pid, vehicles(simulator)
            os.kill(lost, signal.SIGKILL)
            ending = simulator.ended(10.0)
            assert ending is not None
            assert ending.sentence == "the bundled simulator ended (signal 9)"
        simulator.recall()
        assert gone(orphan)
        with flying(simulator):
            assert simulator.pid != lost
    assert not Path(f"/proc/{simulator.pid}").exists()
