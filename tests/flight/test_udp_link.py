"""UDP links: arrival stamps, other senders, and the vehicle's change of port, on real sockets."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator

import pytest

from offboard.link import clock
from offboard.link.connection import open_link
from offboard.link.interface import Chunk, Link, LinkReport
from offboard.link.udp import LOOK_EVERY_S, UdpLink
from offboard.mavlink.senders import PEER_SILENT_S

LOCAL = "127.0.0.1"
Ends = tuple[UdpLink, socket.socket, socket.socket]


@pytest.fixture
def ends() -> Iterator[Ends]:
    """A link that listens, the socket of a vehicle, and that of another program."""
    link = open_link(f"udpin:{LOCAL}:0")
    assert isinstance(link, UdpLink)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        for one in (vehicle, other):
            one.settimeout(5.0)
            one.connect((LOCAL, link.port))
        yield link, vehicle, other
    link.close()


@pytest.fixture
def now_s(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time of the link's clock, which the test sets."""
    now_s = [clock.monotonic_s()]
    monkeypatch.setattr(clock, "monotonic_s", lambda: now_s[0])
    return now_s


def received(link: Link) -> list[Chunk]:
    link.wait(1.0)
    return link.receive()


def data(chunks: list[Chunk]) -> list[bytes]:
    return [chunk.data for chunk in chunks]


def test_a_datagram_has_the_time_of_its_arrival_not_of_its_reading(ends: Ends) -> None:
    link, vehicle, _ = ends
    before_s = time.monotonic()
    vehicle.send(b"first")
    between_s = time.monotonic()
    time.sleep(0.1)
    vehicle.send(b"second")
    time.sleep(0.1)
    first, second = received(link)
    assert before_s - 1e-4 <= first.arrived_s <= between_s + 1e-4
    assert between_s + 0.1 <= second.arrived_s <= time.monotonic() - 0.1
    assert (first.peer, second.peer) == (vehicle.getsockname(), vehicle.getsockname())


@pytest.mark.parametrize("jump_s", [-3600.0, 3600.0])
def test_a_clock_that_is_set_does_not_move_arrivals(
    jump_s: float, ends: Ends, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unix time jumps between the arrival and its reading."""
    link, vehicle, _ = ends
    assert link.receive() == []
    empty_s, right = time.monotonic(), clock.monotonic_less_unix_s
    vehicle.send(b"x")
    monkeypatch.setattr(clock, "monotonic_less_unix_s", lambda: right() - jump_s)
    (chunk,) = received(link)
    assert empty_s - 0.01 <= chunk.arrived_s <= time.monotonic()


def test_other_senders_are_counted_and_neither_delay_nor_displace_the_vehicle(ends: Ends) -> None:
    link, vehicle, other = ends
    other.send(b"waits already")
    vehicle.send(b"v1")
    link.follow(vehicle.getsockname())
    vehicle.send(b"v2")
    for _ in range(20_000):  # ten times the buffer
        other.send(bytes(1000))
    vehicle.send(b"v3")
    time.sleep(LOOK_EVERY_S)
    heard = [*received(link), *link.receive()]
    assert data(heard) == [b"v1", b"v2", b"v3"]
    assert [chunk.arrived_s for chunk in heard] == sorted(chunk.arrived_s for chunk in heard)
    looks = 0
    while looks < 20:
        vehicle.send(b"v")
        time.sleep(LOOK_EVERY_S)
        assert set(data(received(link))) == {b"v"}
        looks += 1
    assert 64 * 22 > link.report.ignored > 500  # of those that fit into the buffer
    name = f" from {LOCAL}:{other.getsockname()[1]}, which is not the vehicle, "
    assert all(name in sentence for sentence in link.report.news())
    assert link.report.news() == []


def test_frames_reach_the_vehicle_before_and_after_it_is_followed(ends: Ends) -> None:
    """And no other program gets the port: with pymavlink's SO_REUSEADDR it would take the vehicle's
    datagrams."""
    link, vehicle, _ = ends
    link.send(b"nobody", None)
    for sent in (b"one", b"two"):
        link.send(sent, vehicle.getsockname())
        assert vehicle.recv(100) == sent
        for option in (socket.SO_REUSEADDR, socket.SO_REUSEPORT):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
                other.setsockopt(socket.SOL_SOCKET, option, 1)
                with pytest.raises(OSError, match="in use"):
                    other.bind(("0.0.0.0", link.port))
        link.follow(vehicle.getsockname())


def test_another_port_is_heard_after_a_silence_that_was_observed(
    ends: Ends, now_s: list[float]
) -> None:
    link, vehicle, other = ends
    link.follow(vehicle.getsockname())
    for _ in range(4):
        now_s[0] += 0.4 * PEER_SILENT_S
        vehicle.send(b"v")
        other.send(b"no")
        assert data(received(link)) == [b"v"]
    for silent_s, heard in ((0.9, []), (0.2, [b"moved"])):
        now_s[0] += silent_s * PEER_SILENT_S
        other.send(b"moved")
        assert data(link.receive()) == heard
    link.follow(other.getsockname())
    vehicle.send(b"of another now")
    other.send(b"v")
    assert data(received(link)) == [b"v"]


def test_our_own_pause_is_no_silence_of_the_vehicle(ends: Ends, now_s: list[float]) -> None:
    """Stopped for 3 s: the vehicle's datagrams wait, but a flood may have dropped the newest."""
    link, vehicle, other = ends
    link.follow(vehicle.getsockname())
    vehicle.send(b"v")
    now_s[0] += 3.0
    other.send(b"spoofed")
    assert data(received(link)) == [b"v"]
    now_s[0] += 0.9 * PEER_SILENT_S
    other.send(b"spoofed")
    assert link.receive() == []


def test_udpout_hears_only_its_peer() -> None:
    """A refused datagram does not cost the next one: a connected socket reports the ICMP message
    of the one before instead of sending."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((LOCAL, 0))
        place = probe.getsockname()
    link = open_link(f"udpout:{LOCAL}:{place[1]}")
    link.send(b"too early", None)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        peer.bind(place)
        peer.settimeout(5.0)
        link.send(b"heard", None)
        heard, ours = peer.recvfrom(100)
        assert heard == b"heard"
        other.sendto(b"no", ours)
        peer.sendto(b"yes", ours)
        assert data(received(link)) == [b"yes"]
        assert link.receive() == []
    link.close()


def test_senders_are_named_at_powers_of_ten_and_bounded_in_number() -> None:
    report = LinkReport()
    for _ in range(100):
        report.count("a:1", 1)
    named = [sentence.partition(" from")[0] for sentence in report.news()]
    assert named == ["1 datagram", "10 datagrams", "100 datagrams"]
    report.count("b:2", 78_000)
    assert report.news() == ["78,000 datagrams from b:2, which is not the vehicle, were ignored"]
    for port in range(1000):
        report.count(f"c:{port}", 1)
    assert len(report.news()) == 6 + 3  # six more names, then 1, 10 and 100 others
    assert report.ignored == 100 + 78_000 + 1000
