"""The `simulator` process: real UDP, real time and lockstep, vehicles, clients, wrong options."""

from __future__ import annotations

import os
import re
import signal
import socket
import time
from collections import Counter
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import pytest
from processes import Called
from sim_peer import OFFBOARD, Peer, simulator

from offboard.documents import shipped

QUIET = ("--gcs", "none")
FLIGHT_TEXTS = [
    "Armed by external command",
    "Takeoff detected",
    "Landing at current position",
    "Landing detected",
    "Disarmed by landing",
]


def to(peer: Peer) -> tuple[str, str]:
    return "--connect", f"udpout:127.0.0.1:{peer.port}"


@pytest.mark.slow
def test_a_flight_in_real_time() -> None:
    with Peer() as peer, simulator(*to(peer), *QUIET, "--scenario", "calm") as process:
        peer.listen(lambda: peer.time_s > 0.5)
        begun = time.monotonic(), peer.time_s
        peer.fly()
        ratio = (peer.time_s - begun[1]) / (time.monotonic() - begun[0])
        assert process.stop() < 0.5
    assert peer.texts == FLIGHT_TEXTS
    assert 0.5 < ratio < 1.05  # never faster than real time; a shared machine may hold it up
    assert [m.result for m in peer.of("COMMAND_ACK")] == [0, 0, 0, 0]
    assert OFFBOARD in {m.custom_mode for m in peer.of("HEARTBEAT")}


@pytest.mark.slow
def test_speed() -> None:
    with Peer() as peer, simulator(*to(peer), *QUIET, "--speed", "5") as process:
        peer.listen(lambda: peer.time_s > 1.0)
        begun = time.monotonic(), peer.time_s
        peer.listen(lambda: peer.time_s > begun[1] + 10.0)
        ratio = (peer.time_s - begun[1]) / (time.monotonic() - begun[0])
        assert process.popen.poll() is None
    assert 2.0 < ratio < 5.5  # a shared machine may hold it up


def lockstep_bytes() -> bytes:
    with Peer() as peer, simulator(*to(peer), *QUIET, "--lockstep", "--seed", "3") as process:
        peer.fly()
        assert process.popen.poll() is None
    assert peer.texts == FLIGHT_TEXTS
    return bytes(peer.raw)


def test_lockstep_flights_with_one_seed_are_byte_identical() -> None:
    first = lockstep_bytes()
    assert len(first) > 100_000
    assert first == lockstep_bytes()


def test_lockstep_waits_for_a_slow_companion() -> None:
    """Virtual time stands still while nobody answers; what comes before the answer counts."""
    with Peer() as peer, simulator(*to(peer), *QUIET, "--lockstep", "--patience", "20"):
        peer.listen(lambda: peer.time_s > 1.0)
        peer.answers_timesync = False
        known = peer.time_s
        peer.listen(lambda: peer.of("TIMESYNC")[-1].ts1 > known * 1e9)
        stamp_ns = peer.of("TIMESYNC")[-1].ts1
        count = len(peer.received)
        time.sleep(0.3)
        peer.answers_timesync = True
        peer.listen(lambda: len(peer.received) > count + 50)  # it asks again after a second
        later = [m.ts1 for _, m in peer.received[count:] if m.get_type() == "TIMESYNC"]
    assert later[0] == stamp_ns
    assert 16_000_000 <= later[1] - stamp_ns <= 24_000_000


def test_a_companion_that_falls_silent_in_flight_is_noticed() -> None:
    options = (*QUIET, "--lockstep", "--patience", "2", "--scenario", "calm")
    with Peer() as peer, simulator(*to(peer), *options) as process:
        peer.listen(lambda: peer.vehicle is not None)
        peer.heartbeat()
        peer.listen(lambda: peer.time_s > 4.2)
        peer.command(400, 1)
        peer.command(22, *(float("nan"),) * 7)
        peer.listen(lambda: peer.time_s > 12.0)
        peer.attitude(0.49)
        peer.command(176, 1, 6)
        peer.listen(lambda: peer.time_s > 12.5)
        peer.answers_timesync = False
        code, errors = process.finish(20.0)
    assert code == 3
    assert "stopped answering at 12." in errors
    assert "Traceback" not in errors


@pytest.mark.parametrize(
    ("number", "options"), [(signal.SIGTERM, ()), (signal.SIGINT, ("--lockstep",))]
)
def test_signals_stop_it_cleanly(number: int, options: tuple[str, ...]) -> None:
    with Peer() as peer, simulator(*to(peer), *QUIET, *options) as process:
        assert process.ready_line() == (
            "px4 vehicle px4_sih, system 1, scenario px4_like, seed 7:"
            f" sending to 127.0.0.1:{peer.port}"
        )
        peer.listen(lambda: len(peer.received) > 3)
        os.kill(process.popen.pid, number)
        code, errors = process.finish(5.0)
    assert (code, errors) == (0, "")


def test_the_duration_ends_it_though_nobody_listens(called: Called) -> None:
    options = ("--connect", "udpout:127.0.0.1:9", "--duration", "2", "--speed", "20")
    assert called("simulator", *QUIET, *options)[::2] == (0, "")


def test_it_can_wait_to_be_spoken_to_and_shifts_its_system() -> None:
    with Peer() as peer:
        free = Peer()
        port = free.port
        free.__exit__()
        options = ("--connect", f"udpin:127.0.0.1:{port}", "--instance", "6")
        with simulator(*options, *QUIET) as process:
            assert process.ready_line().endswith(f"waiting at 127.0.0.1:{port}")
            peer.vehicle = ("127.0.0.1", port)
            peer.heartbeat()
            peer.listen(lambda: len(peer.of("HEARTBEAT")) > 0)
    assert peer.of("HEARTBEAT")[0].get_srcSystem() == 7


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--scenario", "storm"), "there is no scenario named 'storm'; known are all_together, "),
        (("--vehicle", "no/such.yaml"), "no/such.yaml cannot be read: No such file"),
        (("--firmware", "betaflight"), "--firmware betaflight: unknown; there is px4"),
        (("--connect", "tcp:127.0.0.1:1"), "tcp:127.0.0.1:1 is not a link"),
        (("--connect", "udpout:127.0.0.1:99999"), "is not a link"),
        (("--speed", "0"), "--speed 0: must be 0.1 .. 1000"),
        (("--speed", "nan"), "--speed nan: must be 0.1 .. 1000"),
        (("--speed", "2", "--lockstep"), "exclude each other"),
        (("--seed", "-1"), "--seed"),
        (
            ("--log", "no/such/x.tlog"),
            "--log no/such/x.tlog cannot be written: No such file or directory",
        ),
        (("--no-such-option",), "--no-such-option"),
        (("--instances", "2", "--lockstep"), "--lockstep and --instances exclude each other"),
        (("--instances", "20", "--instance", "240"), "system ids end at 250"),
    ],
)
def test_wrong_options_are_refused(options: tuple[str, ...], says: str, called: Called) -> None:
    code, _, errors = called("simulator", *QUIET, *options)
    assert code == 2
    assert says in errors
    assert "Traceback" not in errors


def test_a_vehicle_that_cannot_come_down_is_told(called: Called, tmp_path: Path) -> None:
    path = tmp_path / "light.yaml"
    shipped = Path(__file__).parents[2] / "config" / "vehicles" / "px4_sih.yaml"
    path.write_text(re.sub(r"hover_thrust: \S+", "hover_thrust: 0.1", shipped.read_text()))
    options = ("--vehicle", str(path), "--connect", "udpout:127.0.0.1:9", "--duration", "0.1")
    code, _, errors = called("simulator", *QUIET, *options)
    assert called("simulator", *QUIET, *options, "--param", "MPC_THR_MIN=0.09")[::2] == (0, "")
    assert code == 0
    assert "MPC_THR_MIN is 0.12, which lifts a vehicle that hovers at 0.1" in errors


def test_a_port_in_use_is_refused(called: Called) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        code, _, errors = called("simulator", "--connect", f"udpin:127.0.0.1:{port}", *QUIET)
    assert code == 2
    assert errors == f"udpin:127.0.0.1:{port} cannot be opened: Address already in use\n"


@pytest.mark.slow
def test_a_vehicle_takes_little_memory() -> None:
    with Peer() as peer, simulator(*to(peer), "--speed", "20") as process:
        peer.listen(lambda: peer.time_s > 10.0)
        status = Path(f"/proc/{process.popen.pid}/status").read_text()
    (peak_kb,) = re.findall(r"VmHWM:\s+(\d+) kB", status)
    assert int(peak_kb) < 240_000  # 150,000 after the import of numba 0.68


# -- several vehicles, several clients ------------------------------------------------------------


def free_ports(count: int) -> int:
    """The first of so many free UDP ports in a row."""
    for first in range(23000, 30000, count):
        with ExitStack() as stack:
            try:
                for port in range(first, first + count):
                    sock = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                    sock.bind(("127.0.0.1", port))
            except OSError:
                continue
            return first
    raise AssertionError("no free ports")


def test_instances_have_ports_and_systems_of_their_own_and_keep_time() -> None:
    first = free_ports(3)
    heard: list[list[int]] = []
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket(type=socket.SOCK_DGRAM)) for _ in range(3)]
        for port, sock in enumerate(sockets, first):
            sock.bind(("127.0.0.1", port))
            sock.settimeout(20.0)
        options = ("--connect", f"udpout:127.0.0.1:{first}", "--gcs", "none", "--instances", "3")
        process = stack.enter_context(simulator(*options, "--instance", "4", "--duration", "2"))
        for sock in sockets:
            heard.append([datagram[5] for datagram in (sock.recv(2000) for _ in range(20))])
        output, errors = process.popen.communicate(timeout=20.0)
    assert heard == [[5] * 20, [6] * 20, [7] * 20]
    assert process.popen.returncode == 0
    assert errors == ""
    lines = output.splitlines()
    seeds = [re.findall(r"seed (\d+)", line)[0] for line in lines[:3]]
    assert seeds == ["7", "8", "9"]
    steps = re.fullmatch(
        r"3 vehicles: \d+ of (\d+) deadlines missed, at worst .* ms late", lines[3]
    )
    assert steps is not None
    assert int(steps[1]) == 500


def gaps(peer: Peer) -> int:
    """Messages that should have come between those that came."""
    numbers = [message.get_seq() for _, message in peer.received]
    return sum((b - a - 1) % 256 for a, b in pairwise(numbers))


def test_both_links_serve_several_clients_at_once() -> None:
    with ExitStack() as stack:
        companion, station, late, other = (stack.enter_context(Peer()) for _ in range(4))
        stack.enter_context(
            simulator(
                *("--connect", f"udpout:127.0.0.1:{companion.port}"),
                *("--gcs", f"udpout:127.0.0.1:{station.port}"),
                *("--scenario", "calm"),
            )
        )
        companion.listen(lambda: companion.vehicle is not None)
        station.listen(lambda: station.vehicle is not None)
        assert companion.vehicle != station.vehicle
        for peer, link in ((late, station), (other, companion)):
            peer.vehicle = link.vehicle
            peer.heartbeat()
        peers = (companion, station, late, other)
        for peer in peers:
            peer.listen(lambda peer=peer: peer.time_s > 4.0)
        late.command(400, 1)  # a client that came later arms; every client of the link is told
        for peer in (late, station):
            peer.listen(lambda peer=peer: len(peer.of("COMMAND_ACK")) == 1)
        for peer in peers:
            peer.listen(lambda peer=peer: peer.time_s > 5.5)
            peer.listen(lambda peer=peer: peer.of("HEARTBEAT")[-1].base_mode & 128)
            assert gaps(peer) == 0
        assert not companion.of("COMMAND_ACK") + other.of("COMMAND_ACK")
    rates = [Counter(m.get_type() for _, m in peer.received) for peer in peers]
    assert rates[0]["ATTITUDE"] > 4 * rates[1]["ATTITUDE"]
    assert rates[2]["ATTITUDE"] > 30
    assert late.texts == ["Armed by external command"]


def test_scenarios_are_listed_with_what_they_are(called: Called) -> None:
    code, output, errors = called("simulator", "--list-scenarios")
    assert (code, errors) == (0, "")
    listed = dict(re.split(r"\s+", line, maxsplit=1) for line in output.splitlines())
    assert listed == shipped.descriptions("scenario")
