"""The `simulator` process: its links, how it ends, several vehicles; and that of `--sitl`, which
flies one vehicle after another and ends each of them.

A companion that is late or silent in lockstep: `wire/test_sim_sockets.py`, `test_same_bytes.py`.
Several clients of a link: `wire/test_sim_sockets.py`, `wire/test_sim_link.py`.
"""

from __future__ import annotations

import re
import signal
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from processes import Called, eventually, free_port
from sim_peer import Peer, simulator

from offboard.analysis import tlog
from offboard.flight.flight import Flight
from offboard.flight.phases import Phase
from offboard.run.configuration import load
from offboard.run.flight import Simulated, fly
from offboard.run.sitl import Ending, SimulatorProcess

QUIET = ("--gcs", "none")


def test_udpin_simulator_waits_for_a_client_and_ends_on_sigint() -> None:
    port = free_port()
    options = ("--connect", f"udpin:127.0.0.1:{port}", "--instance", "6", "--lockstep")
    with Peer() as peer, simulator(*options, *QUIET) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == (
            "px4 vehicle px4_sih, system 7, scenario px4_like, seed 7:"
            f" waiting at 127.0.0.1:{port}\n"
        )
        peer.vehicle = ("127.0.0.1", port)
        peer.heartbeat()
        peer.listen(lambda: "HEARTBEAT" in peer.newest)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=10.0)
    assert peer.newest["HEARTBEAT"].get_srcSystem() == 7
    assert (process.returncode, errors) == (0, "")


def test_duration_ends_a_simulator_without_clients(called: Called) -> None:
    for link, does in (("udpout:127.0.0.1:9", "sending to"), ("tcpin:127.0.0.1:{}", "waiting at")):
        link = link.format(free_port())
        options = ("--connect", link, "--duration", "2", "--speed", "20")
        code, said, errors = called("simulator", *QUIET, *options)
        assert (code, errors) == (0, "")
        assert f"{does} {link.partition(':')[2]}" in said


def test_instances_have_their_own_ports_systems_and_seeds() -> None:
    ports = [free_port() for _ in range(3)]
    while ports[2] - ports[0] != 2:  # in a row
        ports = [*ports[1:], free_port()]
    heard: list[list[int]] = []
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket(type=socket.SOCK_DGRAM)) for _ in range(3)]
        for port, sock in zip(ports, sockets, strict=True):
            sock.bind(("127.0.0.1", port))
            sock.settimeout(20.0)
        options = ("--connect", f"udpout:127.0.0.1:{ports[0]}", "--gcs", "none", "--instances", "3")
        process = stack.enter_context(simulator(*options, "--instance", "4", "--duration", "1"))
        for sock in sockets:
            heard.append([datagram[5] for datagram in (sock.recv(2000) for _ in range(20))])
        output, errors = process.communicate(timeout=20.0)
    assert heard == [[5] * 20, [6] * 20, [7] * 20]
    assert (process.returncode, errors) == (0, "")
    assert re.findall(r"seed (\d+)", output) == ["7", "8", "9"]
    assert re.search(r"3 vehicles: \d+ of 250 deadlines missed, at worst .* ms late", output)


# --- the process of `--sitl` ---

KILLED = Ending("the bundled simulator ended (signal 9)", unusable=False)
SHORT = ("reference.height_m=1", "identify.excite=false")


@contextmanager
def flying(simulator: SimulatorProcess) -> Iterator[None]:
    """Launch a vehicle in lockstep, which has sent something then."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours:
        ours.bind(("127.0.0.1", 0))
        ours.settimeout(30.0)
        port = ours.getsockname()[1]
        simulator.launch(["--connect", f"udpout:127.0.0.1:{port}", "--gcs", "none", "--lockstep"])
        assert ours.recv(65535)
        yield
        simulator.recall()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--scenario", "storm"], "there is no scenario named 'storm'; known are"),
        (["--firmware", "betaflight"], "--firmware betaflight is unknown"),
    ],
)
def test_simulator_process_reports_its_end_and_launches_the_next(
    options: list[str], says: str
) -> None:
    simulator = SimulatorProcess()
    simulator.launch(options)
    eventually(simulator.ending)
    ending = simulator.ending()
    assert ending is not None
    assert (ending.unusable, ending.sentence.startswith(says)) == (True, True)
    simulator.recall()
    with flying(simulator):
        assert simulator.ending() is None
        simulator.process.kill()
        eventually(lambda: simulator.ending() == KILLED)  # not the previous sentence
    with flying(simulator):
        assert simulator.process.stdin is not None
        simulator.process.stdin.close()  # as when this process is killed
        eventually(simulator.ending)


def test_killed_simulator_ends_the_flight(tmp_path: Path) -> None:
    simulator = SimulatorProcess()

    def kill(companion: Flight) -> None:
        if companion.phase is Phase.TRACK:
            simulator.process.kill()

    config = load("flight", choices={"reference": "hover"}, assignments=SHORT)
    outcome = fly(
        config, tmp_path / "x", Simulated(scenario="calm"), simulator=simulator, progress=kill
    )
    assert (outcome.exit_code, outcome.sentence) == (4, KILLED.sentence)
    log = tlog.read(tmp_path / "x" / "flight.tlog")
    assert sum(entry.name == "SET_ATTITUDE_TARGET" for entry in log) > 50
