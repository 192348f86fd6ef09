"""The simulator's UDP and TCP links on loopback; lockstep without a companion and after its
end; bad links: each impairment against its definition, in numbers."""

from __future__ import annotations

import select
import socket
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from random import Random
from typing import Any

import pytest
from processes import free_port
from pymavlink.dialects.v20 import common as mavlink

from simulator import config, run
from simulator.faults.link import Stranger
from simulator.firmware.px4 import PX4
from simulator.instance import Instance
from simulator.link.framing import frames
from simulator.link.impairment import Channel, Impairment
from simulator.link.sockets import (
    UNSENT_MAX,
    LinkError,
    TcpLink,
    UdpLink,
    open_beside,
    open_link,
    shifted,
    wait,
    whole_frames,
)
from simulator.run import Endpoint, Runner
from simulator.vehicle.conditions import Conditions

CODEC = mavlink.MAVLink(None, srcSystem=255)
HEARTBEAT = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(CODEC)
HEARTBEAT_V1 = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(CODEC, force_mavlink1=True)


def bound() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    sock.setblocking(False)
    return sock


@pytest.fixture
def companion() -> Iterator[socket.socket]:
    with bound() as sock:
        yield sock


@pytest.fixture
def link(companion: socket.socket) -> Iterator[UdpLink]:
    with closing(open_link(f"udpout:127.0.0.1:{companion.getsockname()[1]}", 0)) as opened:
        assert isinstance(opened, UdpLink)
        yield opened


@pytest.fixture
def server() -> Iterator[TcpLink]:
    with closing(open_link(f"tcpin:127.0.0.1:{free_port()}", 0)) as opened:
        assert isinstance(opened, TcpLink)
        yield opened


def instance(*faults: Stranger) -> Instance:
    vehicle = config.vehicle(PX4.vehicle)
    return Instance(PX4, vehicle, Conditions(), 1, lockstep=True, faults=faults)


# -- lockstep --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("answers", "says"),
    [
        (0, "no companion answered TIMESYNC within 0.1 s: start one, or run without --lockstep"),
        (1, "the companion stopped answering at 0.02 s"),
    ],
)
def test_lockstep_ends_if_the_companion_does_not_answer(
    answers: int,
    says: str,
    link: UdpLink,
    companion: socket.socket,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(run, "ANSWER_TIMEOUT_S", 0.1)
    for _ in range(answers):
        answer = mavlink.MAVLink_timesync_message(1, 8_000_000).pack(mavlink.MAVLink(None))
        companion.sendto(answer, ("127.0.0.1", link.port))
    reports: list[str] = []
    runner = Runner([Endpoint(instance(), link)], lambda: False, reports.append)
    assert runner.lockstep() == says
    assert reports == []


def test_a_stranger_sends_from_another_port_of_the_same_host(
    link: UdpLink, companion: socket.socket
) -> None:
    """In lockstep its datagrams come before the telemetry of the same 20 ms. Only a UDP link can
    have a stranger."""
    fault = Stranger.model_validate({"fault": "stranger", "rate_hz": 250.0, "size_bytes": 33})
    flown = instance(fault)
    endpoint = Endpoint(flown, link, strangers=(open_beside(link),))
    flown.advance_to_barrier()
    endpoint.send_barrier()
    received = []
    while select.select([companion], [], [], 0.0)[0]:
        received.append(companion.recvfrom(2048))
    ports = [sender[1] for _, sender in received]
    ours = ports.index(link.port)
    assert ours == flown.steps
    assert {sender[0] for _, sender in received} == {"127.0.0.1"}
    assert len(set(ports[:ours])) == 1
    assert set(ports[ours:]) == {link.port}
    assert {len(datagram) for datagram, _ in received[:ours]} == {33}


def test_senders_become_peers_up_to_a_limit(link: UdpLink, companion: socket.socket) -> None:
    others = [bound() for _ in range(20)]
    for other in others:
        other.sendto(b"x", ("127.0.0.1", link.port))
        wait([link], 1.0)
        assert link.receive() == b"x"
    link.send([b"telemetry"])
    heard = [bool(select.select([other], [], [], 0.0)[0]) for other in others]
    for other in others:
        other.close()
    assert heard == [False] * 5 + [True] * 15
    assert companion.recv(100) == b"telemetry"


# -- TCP, like ArduPilot's SITL --------------------------------------------------------------


def client(server: TcpLink) -> socket.socket:
    connected = socket.create_connection(("127.0.0.1", server.port))
    connected.settimeout(2.0)
    assert heard(server) is None  # accepts the client
    return connected


def heard(server: TcpLink) -> bytes | None:
    assert wait([server], 2.0) == [server]
    return server.receive()


def test_stream_is_cut_only_between_whole_frames() -> None:
    stream = b"x" + HEARTBEAT + HEARTBEAT_V1 + HEARTBEAT
    wholes = [0, 1, 1 + len(HEARTBEAT), 1 + len(HEARTBEAT + HEARTBEAT_V1), len(stream)]
    for length in range(len(stream) + 1):
        assert whole_frames(stream[:length]) == max(w for w in wholes if w <= length)


def test_tcp_clients_connect_and_disconnect(server: TcpLink) -> None:
    one, other = client(server), client(server)
    one.sendall(HEARTBEAT[:5])
    assert heard(server) is None
    one.sendall(HEARTBEAT[5:] + HEARTBEAT_V1)
    assert heard(server) == HEARTBEAT + HEARTBEAT_V1
    server.send([b"telemetry"])
    assert one.recv(100) == other.recv(100) == b"telemetry"
    one.close()
    assert heard(server) is None
    with client(server) as again:
        server.send([b"again"])
        assert again.recv(100) == other.recv(100) == b"again"
    other.close()


def test_tcp_client_that_never_reads_is_disconnected(server: TcpLink) -> None:
    idle, other = client(server), client(server)
    piece, count = bytes(65536), 0
    for _ in range(20 * UNSENT_MAX // len(piece)):
        server.send([piece])
        count += len(other.recv(1 << 20))
    assert count > 15 * UNSENT_MAX
    left = 0
    while data := idle.recv(1 << 20):
        left += len(data)
    assert left < 15 * UNSENT_MAX  # then the connection was closed
    idle.close()
    other.close()


def test_unusable_links_are_refused_and_instance_ports_shifted(server: TcpLink) -> None:
    with pytest.raises(LinkError, match="cannot be opened"):
        open_link(f"tcpin:127.0.0.1:{server.port}", 0)
    with pytest.raises(LinkError, match="fault stranger needs a UDP link"):
        open_beside(server)
    assert shifted("tcpin:127.0.0.1:5760", 2) == "tcpin:127.0.0.1:5780"
    assert shifted("udpin:127.0.0.1:5760", 2) == "udpin:127.0.0.1:5762"


# --- bad links: each impairment against its definition --------------------------------------------


STEP_US = 4000


def carried(**settings: Any) -> list[tuple[int, bytes]]:
    """(arrival in us, datagram) of 2000 numbered datagrams of 32 bytes, one sent per 4 ms."""
    channel = Channel(Impairment(**settings), Random(5))
    arrived: list[tuple[int, bytes]] = []
    for step in range(3000):
        now_us = step * STEP_US
        if step < 2000:
            channel.put(step.to_bytes(4, "big") * 8, now_us)
        arrived += [(now_us, datagram) for datagram in channel.take(now_us)]
    return arrived


def numbers(arrived: list[tuple[int, bytes]]) -> list[int]:
    return [int.from_bytes(datagram[:4], "big") for _, datagram in arrived]


def delays_us(arrived: list[tuple[int, bytes]]) -> list[int]:
    pairs = zip(arrived, numbers(arrived), strict=True)
    return [at_us - number * STEP_US for (at_us, _), number in pairs]


def test_latency_with_jitter_or_a_ramp_keeps_the_order() -> None:
    assert set(delays_us(carried(latency_s=0.06))) == {60_000}
    jittering, growing = carried(latency_s=0.02, jitter_s=0.04), carried(latency_s=0.8, ramp_s=4.0)
    assert numbers(jittering) == numbers(growing) == list(range(2000))
    assert min(delays_us(jittering)) < 40_000
    assert max(delays_us(jittering)) == 60_000
    late_us = delays_us(growing)
    assert late_us[0] == 0
    assert late_us[500] == pytest.approx(400_000, abs=STEP_US)  # 2 s after the first
    assert set(late_us[1000:]) == {800_000}


def test_link_loses_duplicates_reorders_and_corrupts_datagrams() -> None:
    assert 1400 < len(carried(loss=0.25)) < 1600
    assert carried(loss=1.0) == []
    kept = numbers(carried(duplication=0.25))
    assert 2400 < len(kept) < 2600
    assert sorted(set(kept)) == list(range(2000))
    reordered = carried(reorder=0.1, reorder_s=0.02)
    late = [delay for delay in delays_us(reordered) if delay]
    assert 150 < len(late) < 250
    assert set(late) == {20_000}
    assert sorted(numbers(reordered)) == list(range(2000)) != numbers(reordered)
    flipped = [
        int.from_bytes(got, "big") ^ int.from_bytes(step.to_bytes(4, "big") * 8, "big")
        for step, (_, got) in enumerate(carried(corruption=0.25))
    ]
    bits = [each.bit_count() for each in flipped]
    assert set(bits) == {0, 1}
    assert 400 < sum(bits) < 600


def test_rate_limited_link_queues_and_then_drops() -> None:
    arrived = carried(rate_bytes_ps=1600.0, queue_bytes=320)
    # 50 datagrams of 32 bytes a second where 250 are sent
    assert len(arrived) == pytest.approx(2000 / 5, abs=12)
    assert max(delays_us(arrived)) == 200_000  # ten in the queue
    times = [at_us for at_us, _ in arrived]
    assert {b - a for a, b in pairwise(times)} == {20_000}


def test_message_rate_limit_thins_telemetry_but_not_answers() -> None:
    codec = mavlink.MAVLink(None)
    channel = Channel(Impairment(message_rate_hz=20.0), Random(1))
    heard: dict[int, int] = {}
    for step in range(2500):
        now_us = step * STEP_US
        messages: list[Any] = [mavlink.MAVLink_attitude_message(step, *(0.1,) * 6)]
        if step % 2 == 0:
            messages.append(mavlink.MAVLink_local_position_ned_message(step, *(0.1,) * 6))
        if step % 500 < 2:
            messages.append(mavlink.MAVLink_command_ack_message(176, 0))
        channel.put(b"".join(message.pack(codec) for message in messages), now_us)
        for datagram in channel.take(now_us):
            for message_id, _ in frames(datagram):
                heard[message_id] = heard.get(message_id, 0) + 1
    assert heard == {30: 200, 32: 200, 77: 10}


def test_datagrams_keep_their_order_after_a_link_fault() -> None:
    channel = Channel(Impairment(latency_s=0.02), Random(1))
    channel.put(b"late", 0)
    channel.on = False
    channel.put(b"next", 4000)
    assert channel.take(4000) == []
    assert channel.take(20_000) == [b"late", b"next"]
    channel.put(b"prompt", 24_000)
    assert channel.take(24_000) == [b"prompt"]


def test_stalled_link_delivers_its_queue_when_the_stall_ends() -> None:
    channel = Channel(Impairment(stalled=True, queue_bytes=320), Random(1))
    sent = [bytes([number]) * 32 for number in range(12)]
    for number, datagram in enumerate(sent):
        channel.put(datagram, number * STEP_US)
        assert channel.take(number * STEP_US) == []
    channel.on = False
    channel.put(b"next", 12 * STEP_US)
    assert channel.take(12 * STEP_US) == [*sent[:10], b"next"]
