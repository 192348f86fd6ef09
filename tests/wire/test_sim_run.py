"""Lockstep without, with and after a companion, on loopback sockets in one thread."""

from __future__ import annotations

import select
import socket
from collections.abc import Iterator
from contextlib import closing

import pytest
from pymavlink.dialects.v20 import common as mavlink
from sim_bench import px4_vehicle

from simulator import run
from simulator.faults import Stranger
from simulator.firmware.px4 import PX4
from simulator.instance import Instance
from simulator.link.sockets import LinkError, UdpLink, free_ports, open_beside, open_link
from simulator.run import Endpoint, Outcome, Runner
from simulator.vehicle.conditions import Conditions


@pytest.fixture
def companion() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.setblocking(False)
        yield sock


@pytest.fixture
def link(companion: socket.socket) -> Iterator[UdpLink]:
    opened = open_link(f"udpout:127.0.0.1:{companion.getsockname()[1]}", 0)
    assert isinstance(opened, UdpLink)
    yield opened
    opened.close()


def runner(link: UdpLink, reports: list[str]) -> Runner:
    instance = Instance(PX4, px4_vehicle(), Conditions(), 1, lockstep=True)
    return Runner([Endpoint(instance, link)], stopping=lambda: False, report=reports.append)


def test_without_a_companion_the_run_ends_with_code_3(
    link: UdpLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "FIRST_ANSWER_TIMEOUT_S", 0.1)
    reports: list[str] = []
    outcome = runner(link, reports).lockstep()
    assert outcome == Outcome(
        3, "no companion answered TIMESYNC within 0.1 s: start one, or run without --lockstep"
    )
    assert reports == []


def test_a_companion_that_answers_only_once_ends_the_run(
    link: UdpLink, companion: socket.socket
) -> None:
    answer = mavlink.MAVLink_timesync_message(1, 8_000_000).pack(mavlink.MAVLink(None))
    companion.sendto(answer, ("127.0.0.1", link.port))
    reports: list[str] = []
    outcome = runner(link, reports).lockstep(0.1)
    assert outcome == Outcome(3, "the companion stopped answering at 0.02 s")
    assert reports == []


def test_senders_become_peers_up_to_a_limit(link: UdpLink, companion: socket.socket) -> None:
    others = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(20)]
    for other in others:
        other.bind(("127.0.0.1", 0))
        other.setblocking(False)
        other.sendto(b"x", ("127.0.0.1", link.port))
        run.wait([link], 1.0)
        assert link.receive() == b"x"
    link.send([b"telemetry"])
    heard = [_received(other) for other in others]
    for other in others:
        other.close()
    assert heard == [None] * 5 + [b"telemetry"] * 15
    assert _received(companion) == b"telemetry"


def _received(sock: socket.socket) -> bytes | None:
    try:
        return sock.recv(100)
    except BlockingIOError:
        return None


def test_a_stranger_sends_from_another_port_of_the_same_host(
    link: UdpLink, companion: socket.socket
) -> None:
    """In lockstep before each barrier: the telemetry of these 20 ms follows."""
    fault = Stranger.model_validate({"fault": "stranger", "rate_hz": 250.0, "size_bytes": 33})
    instance = Instance(PX4, px4_vehicle(), Conditions(), 1, lockstep=True, faults=(fault,))
    endpoint = Endpoint(instance, link, strangers=(open_beside(link),))
    instance.advance_to_barrier()
    endpoint.send_barrier()
    received = []
    while select.select([companion], [], [], 0.0)[0]:
        received.append(companion.recvfrom(2048))
    ports = [sender[1] for _, sender in received]
    ours = ports.index(link.port)
    assert ours == instance.steps
    assert {sender[0] for _, sender in received} == {"127.0.0.1"}
    assert len(set(ports[:ours])) == 1
    assert set(ports[ours:]) == {link.port}
    assert {len(datagram) for datagram, _ in received[:ours]} == {33}


def test_a_stranger_needs_a_udp_link() -> None:
    (port,) = free_ports(1)
    refused = pytest.raises(LinkError, match="fault stranger: it needs a UDP link")
    with closing(open_link(f"tcpin:127.0.0.1:{port}", 0)) as connected, refused:
        open_beside(connected)
