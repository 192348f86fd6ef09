"""The `simulator` process: real UDP, real time and lockstep, several vehicles, several clients."""

from __future__ import annotations

import re
import signal
import socket
import time
from collections import Counter
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import pytest
from processes import Called, free_port, hovering
from sim_peer import Peer, simulator

QUIET = ("--gcs", "none")


def to(peer: Peer) -> tuple[str, str]:
    return "--connect", f"udpout:127.0.0.1:{peer.port}"


def test_lockstep_waits_for_a_slow_companion_and_ends_when_it_falls_silent_in_flight(
    tmp_path: Path,
) -> None:
    """Virtual time stands still while nobody answers; what comes before the answer counts."""
    options = (*QUIET, "--lockstep", "--patience", "4", *hovering(tmp_path, 3.0))
    with Peer() as peer, simulator(*to(peer), *options) as process:
        peer.listen(lambda: peer.time_s > 1.0)
        peer.answers_timesync = False
        asked = len(peer.of("TIMESYNC"))
        peer.listen(lambda: len(peer.of("TIMESYNC")) > asked)
        stamp_ns = peer.of("TIMESYNC")[-1].ts1
        count = len(peer.received)
        time.sleep(0.3)
        peer.answers_timesync = True
        peer.listen(lambda: len(peer.received) > count + 50)  # it asks again after a second
        later = [m.ts1 for _, m in peer.received[count:] if m.get_type() == "TIMESYNC"]
        peer.answers_timesync = False
        _, errors = process.communicate(timeout=20.0)
    assert later[0] == stamp_ns
    assert 16_000_000 <= later[1] - stamp_ns <= 24_000_000
    assert (process.returncode, "Traceback" in errors) == (3, False)
    (silent_s,) = re.findall(r"stopped answering at (\d+\.\d+)", errors)
    assert float(silent_s) == pytest.approx(later[-1] * 1e-9, abs=0.2)


def test_it_waits_to_be_spoken_to_shifts_its_system_and_ends_at_an_interrupt() -> None:
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
        peer.listen(lambda: len(peer.of("HEARTBEAT")) > 0)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=10.0)
    assert peer.of("HEARTBEAT")[0].get_srcSystem() == 7
    assert (process.returncode, errors) == (0, "")


def test_the_duration_ends_it_though_nobody_listens(called: Called) -> None:
    for link, does in (("udpout:127.0.0.1:9", "sending to"), ("tcpin:127.0.0.1:{}", "waiting at")):
        link = link.format(free_port())
        options = ("--connect", link, "--duration", "2", "--speed", "20")
        code, said, errors = called("simulator", *QUIET, *options)
        assert (code, errors) == (0, "")
        assert f"{does} {link.partition(':')[2]}" in said


def test_instances_have_ports_and_systems_of_their_own_and_keep_time() -> None:
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


def gaps(peer: Peer) -> int:
    """Messages that should have come between those that came."""
    numbers = [message.get_seq() for _, message in peer.received]
    return sum((b - a - 1) % 256 for a, b in pairwise(numbers))


def test_both_links_serve_several_clients_at_once() -> None:
    """Each is told what any client of its link has commanded, in real time. SIGTERM ends it."""
    with ExitStack() as stack:
        companion, station, late, other = (stack.enter_context(Peer()) for _ in range(4))
        ground = ("--gcs", f"udpout:127.0.0.1:{station.port}")
        process = stack.enter_context(simulator(*to(companion), *ground, "--scenario", "calm"))
        companion.listen(lambda: companion.vehicle is not None)
        station.listen(lambda: station.vehicle is not None)
        companion.listen(lambda: companion.time_s > 0.5)
        begun = time.monotonic(), companion.time_s
        assert companion.vehicle != station.vehicle
        for peer, link in ((late, station), (other, companion)):
            peer.vehicle = link.vehicle
            peer.heartbeat()
        peers = (companion, station, late, other)
        for peer in peers:
            peer.listen(lambda peer=peer: peer.time_s > 4.0)
        late.command(400, 1)  # a client that came later arms
        for peer in (late, station):
            peer.listen(lambda peer=peer: len(peer.of("COMMAND_ACK")) == 1)
        for peer in peers:
            peer.listen(lambda peer=peer: peer.time_s > 5.5)
            peer.listen(lambda peer=peer: peer.of("HEARTBEAT")[-1].base_mode & 128)
            assert gaps(peer) == 0
        late_s = (time.monotonic() - begun[0]) - (peers[0].time_s - begun[1])
        status = Path(f"/proc/{process.pid}/status")
        peak_kb = re.findall(r"VmHWM:\s+(\d+)", status.read_text()) if status.exists() else ()
        process.terminate()
        _, errors = process.communicate(timeout=10.0)
    assert (process.returncode, errors) == (0, "")
    assert late_s > -1.0  # never faster than real time; a shared machine may hold it up
    assert all(int(kb) < 240_000 for kb in peak_kb)  # 150,000 after the import of numba 0.68
    assert not companion.of("COMMAND_ACK") + other.of("COMMAND_ACK")
    rates = [Counter(m.get_type() for _, m in peer.received) for peer in peers]
    assert rates[0]["ATTITUDE"] > 4 * rates[1]["ATTITUDE"]
    assert rates[2]["ATTITUDE"] > 30
    assert late.texts == ["Armed by external command"]
