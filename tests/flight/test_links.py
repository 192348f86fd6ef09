"""Links on real sockets and pseudo-terminals: times of arrival, other senders, a vehicle that
changes its port, full streams, links that break and return, IPv6 addresses."""

from __future__ import annotations

import fcntl
import os
import pty
import select
import socket
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from errno import ENETUNREACH
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from processes import free_port
from pymavlink.dialects.v20 import common as mavlink
from uneventful import uneventful

from offboard.documents.errors import Unavailable
from offboard.flight import telemetry
from offboard.link import clock
from offboard.link.connection import open_link, open_lockstep_link
from offboard.link.interface import Chunk, Link, LinkReport
from offboard.link.stream import BROKEN, RENEWED
from offboard.link.udp import LOOK_EVERY_S, UdpLink
from offboard.mavlink.events import PeerChanged
from offboard.mavlink.framing import FrameSplitter
from offboard.mavlink.senders import PEER_SILENT_S

LOCAL = "127.0.0.1"
TIMEOUT_S = 10.0
TURN_S = 1.0  # longest turn of the loop on a busy machine, whatever the link does
Udp = tuple[UdpLink, socket.socket, socket.socket]
IPV6 = socket.has_ipv6 and Path("/proc/net/if_inet6").exists()


@pytest.fixture
def ends() -> Iterator[ExitStack]:
    """Closes links and their other ends after the test."""
    with ExitStack() as ends:
        yield ends


def opened(address: str, ends: ExitStack) -> Link:
    return ends.enter_context(closing(open_link(address)))


def listening(ends: ExitStack, port: int = 0) -> socket.socket:
    server = ends.enter_context(socket.create_server(("127.0.0.1", port)))
    server.settimeout(TIMEOUT_S)
    return server


def plugged(ends: ExitStack) -> tuple[int, str, Callable[[], object]]:
    """Create a serial device. Return the descriptor of its other end, its path, and a function that
    unplugs it."""
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    unplugs = ends.enter_context(ExitStack())
    unplugs.callback(os.close, ours)
    unplugs.callback(os.close, theirs)
    return ours, os.ttyname(theirs), unplugs.close


def port(link: Link) -> int:
    with socket.socket(fileno=os.dup(link.descriptors()[0])) as ours:
        return int(ours.getsockname()[1])


def turns(link: Link, until: Callable[[bytes], object]) -> bytes:
    """Run turns of the loop until `until` holds for the bytes received, and return these. No turn
    may block."""
    received, deadline_s = b"", time.monotonic() + TIMEOUT_S
    while not until(received):
        began_s = time.monotonic()
        assert began_s < deadline_s, received
        link.wait(0.02)
        received += b"".join(chunk.data for chunk in link.receive())
        link.send(b"\xfd\0\0\0\0\0\0\0\0\0\0\0", None)
        assert time.monotonic() - began_s < TURN_S
    return received


def run(link: Link, seconds: float) -> None:
    end_s = time.monotonic() + seconds
    turns(link, lambda _: time.monotonic() > end_s)


def run_until_it_breaks(link: Link) -> None:
    turns(link, lambda _: BROKEN in link.report.news())


# --- UDP ---


@pytest.fixture
def udp() -> Iterator[Udp]:
    """A listening link, the socket of a vehicle, and the socket of another program."""
    link = open_link(f"udpin:{LOCAL}:{free_port()}")
    assert isinstance(link, UdpLink)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        for one in (vehicle, other):
            one.settimeout(5.0)
            one.connect((LOCAL, port(link)))
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


def test_datagram_time_is_its_arrival_not_its_reading(udp: Udp) -> None:
    """If this process is interrupted, the time may be too old by the length of the interruption."""
    link, vehicle, _ = udp
    for _ in range(5):  # repeat if the computer's clock was set in the meantime
        before_s, offset_s = time.monotonic(), clock.monotonic_less_unix_s()
        vehicle.send(b"first")
        time.sleep(0.5)
        vehicle.send(b"second")
        time.sleep(0.1)
        first, second = received(link)
        if abs(clock.monotonic_less_unix_s() - offset_s) < 0.01:
            break
    assert before_s - 0.5 <= first.arrived_s <= second.arrived_s - 0.05
    assert second.arrived_s <= time.monotonic() - 0.05
    assert (first.peer, second.peer) == (vehicle.getsockname(), vehicle.getsockname())


@pytest.mark.parametrize("jump_s", [-3600.0, 3600.0])
def test_clock_step_does_not_change_arrival_times(
    jump_s: float, udp: Udp, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unix time jumps between the arrival of a datagram and its reading."""
    link, vehicle, _ = udp
    assert link.receive() == []
    empty_s, right = time.monotonic(), clock.monotonic_less_unix_s
    vehicle.send(b"x")
    monkeypatch.setattr(clock, "monotonic_less_unix_s", lambda: right() - jump_s)
    (chunk,) = received(link)
    assert empty_s - 0.01 <= chunk.arrived_s <= time.monotonic()


def test_backward_clock_step_keeps_the_datagram_order(
    udp: Udp, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel stamps the first one before the step of 0.6 s, the second one after it."""
    link, vehicle, _ = udp
    assert link.receive() == []
    stamps_s = iter((time.time(), time.time() - 0.6))
    monkeypatch.setattr("offboard.link.udp._stamp_s", lambda _: next(stamps_s))
    vehicle.send(b"first")
    vehicle.send(b"second")
    first, second = received(link)
    assert data([first, second]) == [b"first", b"second"]
    assert first.arrived_s <= second.arrived_s <= time.monotonic()


def test_flood_of_other_senders_does_not_displace_the_vehicle(udp: Udp) -> None:
    link, vehicle, other = udp
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
    assert 64 * 22 > link.report.ignored > 500  # datagrams that fitted into the buffer
    name = f" from {LOCAL}:{other.getsockname()[1]}, which is not the vehicle, "
    assert all(name in sentence for sentence in link.report.news())
    assert link.report.news() == []


def test_udp_link_reaches_the_vehicle_and_holds_its_port_alone(udp: Udp) -> None:
    """No other program can bind the port: by SO_REUSEADDR, as pymavlink sets it, it would get the
    vehicle's datagrams."""
    link, vehicle, _ = udp
    link.send(b"nobody", None)
    for sent in (b"one", b"two"):
        link.send(sent, vehicle.getsockname())
        assert vehicle.recv(100) == sent
        for option in (socket.SO_REUSEADDR, socket.SO_REUSEPORT):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
                other.setsockopt(socket.SOL_SOCKET, option, 1)
                with pytest.raises(OSError, match="in use"):
                    other.bind(("0.0.0.0", port(link)))
        link.follow(vehicle.getsockname())


def test_new_peer_is_announced_as_host_and_port() -> None:
    flight = uneventful()
    for peer in (("127.0.0.1", 14581), ("::1", 14582, 0, 0)):
        telemetry.update(flight, PeerChanged(peer), 0.0, turned_s=0.0)
    places = [sentence.rpartition(" from ")[2] for sentence in flight.announced]
    assert places == ["127.0.0.1:14581", "[::1]:14582"]


def test_vehicle_may_change_its_port_after_an_observed_silence(
    udp: Udp, now_s: list[float]
) -> None:
    """A pause of this process, here of 3 s, is not a silence of the vehicle: its datagrams wait, or
    other senders have filled the buffer so that the newest were dropped."""
    link, vehicle, other = udp
    link.follow(vehicle.getsockname())
    for passed_s in (0.4, 0.4, 0.4, 1.5):
        now_s[0] += passed_s * PEER_SILENT_S
        vehicle.send(b"v")
        other.send(b"no")
        assert data(received(link)) == [b"v"]
    # whoever has sent while the vehicle did is another program, perhaps with the same system id
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as restarted:
        restarted.connect(other.getpeername())
        for silent_s, heard in ((0.9, []), (0.2, [b"moved"])):
            now_s[0] += silent_s * PEER_SILENT_S
            other.send(b"no")
            restarted.send(b"moved")
            assert data(link.receive()) == heard
        link.follow(restarted.getsockname())
        vehicle.send(b"of another now")
        restarted.send(b"v")
        assert data(received(link)) == [b"v"]
        # once more, to a new port and back
        for _ in range(2):
            now_s[0] += 0.1
            restarted.send(b"v")
            assert data(received(link)) == [b"v"]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
            again.connect(other.getpeername())
            for sender in (again, restarted):
                now_s[0] += 1.1 * PEER_SILENT_S
                sender.send(b"moved")
                assert data(link.receive()) == [b"moved"]
                supervisors = [os.dup(each) for each in link.descriptors()]
                link.follow(sender.getsockname())
                for each in supervisors:
                    os.close(each)
                sender.send(b"v")
                assert data(received(link)) == [b"v"]
        # after a long silence also a sender is heard that has sent while the vehicle did
        for passed_s, heard in ((50.0, []), (15.0, [b"late"])):
            now_s[0] += passed_s
            other.send(b"late")
            assert data(link.receive()) == heard


@pytest.mark.skipif(sys.platform != "linux", reason="macOS has no second address on loopback")
def test_after_a_long_silence_other_hosts_are_heard(udp: Udp, now_s: list[float]) -> None:
    link, vehicle, other = udp
    link.follow(vehicle.getsockname())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as elsewhere:
        elsewhere.bind(("127.0.0.2", 0))
        for silent_s, heard in ((0.0, []), (4.9, []), (0.2, [b"elsewhere"])):
            now_s[0] += silent_s
            elsewhere.sendto(b"elsewhere", other.getpeername())
            assert data(link.receive()) == heard
        vehicle.send(b"v")
        assert data(received(link)) == [b"v"]


def test_udpout_hears_only_its_peer() -> None:
    """After a refused datagram the next one is sent nevertheless, and the peer is heard on a second
    address of this computer. With a connected socket both would fail."""
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
        if sys.platform == "linux":  # macOS has no second address on loopback
            peer.sendto(b"moved", ("127.0.0.2", ours[1]))
            assert data(received(link)) == [b"moved"]
    link.close()


def test_ignored_senders_are_reported_at_powers_of_ten() -> None:
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


# --- streams ---


@pytest.mark.parametrize(
    ("kind", "count"), [("tcp", 20_000), ("serial", 5_000)]
)  # 1 MB and 250 kB exceed the buffers
def test_full_stream_does_not_block_and_sends_the_newest_setpoint(
    kind: str, count: int, ends: ExitStack
) -> None:
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)

    def framed(message: mavlink.MAVLink_message, number: int) -> bytes:
        codec.seq = number % 256
        return bytes(message.pack(codec))

    heartbeat = framed(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), 7)
    level = partial(mavlink.MAVLink_set_attitude_target_message, type_mask=7, q=[0] * 4,
                    target_system=1, target_component=1, body_roll_rate=0, body_pitch_rate=0,
                    body_yaw_rate=0, thrust=0)  # fmt: skip
    setpoints = [framed(level(number), number) for number in range(count + 1)]
    if kind == "tcp":
        server = listening(ends)
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        link = opened(f"tcp:{LOCAL}:{server.getsockname()[1]}", ends)
        theirs = ends.enter_context(server.accept()[0]).fileno()
    else:
        theirs, path, _ = plugged(ends)
        link = opened(f"serial:{path}:57600", ends)
    for each in setpoints[:-1]:  # a TCP link breaks 5 s after the first byte that is not read
        link.send(each, None)
    link.send(heartbeat, None)
    link.send(setpoints[-1], None)
    splitter, frames = FrameSplitter(stream=True), list[Any]()
    while not frames or frames[-1].raw != setpoints[-1]:
        link.receive()
        assert select.select([theirs], [], [], 10.0)[0], "silent"
        frames += splitter.split(os.read(theirs, 65536))
    numbers = [int.from_bytes(f.payload[:4], "little") for f in frames if f.message_id == 82]
    assert all(frame.verified for frame in frames)
    assert numbers == sorted(numbers)
    assert len(numbers) < count  # queued ones were replaced, but not one that was sent in part
    assert frames[-2].raw == heartbeat


def test_tcp_link_reconnects_to_a_returning_peer(ends: ExitStack) -> None:
    server = listening(ends)
    server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    port = server.getsockname()[1]
    link = opened(f"tcp:127.0.0.1:{port}", ends)
    with server.accept()[0] as peer:
        peer.sendall(b"first")
        turns(link, lambda data: data == b"first")
        before = link.opened
        for _ in range(1000):  # more than both ends hold
            link.send(b"old" * 1000, None)
        server.close()
    run_until_it_breaks(link)  # nobody listens now
    assert link.descriptors() == ()
    run(link, 0.7)
    server = listening(ends, port)
    turns(link, lambda _: link.descriptors())
    peer = ends.enter_context(server.accept()[0])
    peer.settimeout(TIMEOUT_S)
    peer.sendall(b"again")
    turns(link, lambda data: data == b"again")
    assert link.report.news() == [RENEWED]
    assert link.opened > before
    after = peer.recv(65536)
    assert len(after) < 12 * 30  # frames sent during the outage were dropped, not queued
    assert b"old" not in after


def test_tcpin_accepts_a_second_client_only_after_silence(ends: ExitStack) -> None:
    link = opened(f"tcpin:127.0.0.1:{free_port()}", ends)
    place = LOCAL, port(link)
    assert link.receive() == []
    link.send(b"to nobody", None)
    vehicle = ends.enter_context(socket.create_connection(place))
    vehicle.settimeout(TIMEOUT_S)
    vehicle.sendall(b"one")
    turns(link, lambda data: data == b"one")
    link.follow("tcp")
    with socket.create_connection(place) as other:
        other.settimeout(TIMEOUT_S)

        def refused(_: bytes) -> bool:
            vehicle.sendall(b".")
            return any("connection from 127.0.0.1" in each for each in link.report.news())

        turns(link, refused)
        assert other.recv(10) == b""  # closed
    run(link, 0.6)
    with socket.create_connection(place) as back:  # the first client has gone without closing
        back.sendall(b"two")
        turns(link, lambda data: data.endswith(b"two"))
        while vehicle.recv(65536):
            pass
    run_until_it_breaks(link)


def test_serial_link_reopens_a_replugged_device(tmp_path: Path, ends: ExitStack) -> None:
    """No other program can open the device: two readers would each get a part of the telemetry."""
    device = tmp_path / "ttyACM0"
    other_end, path, unplug = plugged(ends)
    device.symlink_to(path)
    link = opened(f"serial:{device}:57600", ends)
    os.write(other_end, b"first")
    turns(link, lambda data: data == b"first")
    with pytest.raises(Unavailable, match="another program has it open"):
        open_link(f"serial:{device}:57600")
    unplug()
    device.unlink()
    run_until_it_breaks(link)
    assert link.descriptors() == ()  # an open descriptor would give the device another name
    other_end, path, _ = plugged(ends)
    device.symlink_to(path)
    turns(link, lambda _: link.descriptors())
    os.write(other_end, b"again")
    turns(link, lambda data: data == b"again")


@pytest.mark.parametrize("kind", ["tcp", "serial", "udp"])
def test_wait_does_not_read_arriving_data(kind: str, ends: ExitStack) -> None:
    """The supervisor has the same descriptors, and must find the data for which the controller
    waited."""
    link, send = joined(kind, ends)
    descriptor = link.descriptors()[-1]
    assert waiting_bytes(descriptor) == 0
    began_s = clock.monotonic_s()
    sent_s: list[float] = []

    def send_later() -> None:
        sent_s.append(clock.monotonic_s())
        send(b"\xfd while it waits")

    later = threading.Timer(0.1, send_later)
    later.start()
    link.wait(TIMEOUT_S)
    waited_s = clock.monotonic_s() - began_s
    later.join()
    assert 0.09 < waited_s < 0.09 + TURN_S
    assert waiting_bytes(descriptor) == 16
    link.wait(TIMEOUT_S)  # returns at once
    (chunk,) = link.receive()
    assert chunk.data == b"\xfd while it waits"
    assert sent_s[0] - 1e-4 < chunk.arrived_s < clock.monotonic_s()
    assert link.receive() == []


def joined(kind: str, ends: ExitStack) -> tuple[Link, Callable[[bytes], object]]:
    """Return a link, and a function that sends on its other end."""
    if kind == "serial":
        other_end, path, _ = plugged(ends)
        return opened(f"serial:{path}:57600", ends), partial(os.write, other_end)
    if kind == "tcp":
        server = listening(ends)
        link = opened(f"tcp:127.0.0.1:{server.getsockname()[1]}", ends)
        return link, ends.enter_context(server.accept()[0]).sendall
    link = opened(f"udpin:127.0.0.1:{free_port()}", ends)
    other = ends.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    assert isinstance(link, UdpLink)
    other.connect(("127.0.0.1", port(link)))
    return link, other.send


def waiting_bytes(descriptor: int) -> int:
    """Return the number of received bytes that were not read yet."""
    return int.from_bytes(fcntl.ioctl(descriptor, termios.FIONREAD, bytes(4)), sys.byteorder)


def test_localhost_is_resolved_as_ipv4(ends: ExitStack, monkeypatch: pytest.MonkeyPatch) -> None:
    """If /etc/hosts has only ::1 for localhost, glibc answers 127.0.0.1 to a request for IPv4."""
    asked = socket.getaddrinfo

    def told(host: str, port: int, family: int = 0, type: int = 0) -> Any:
        name = LOCAL if family == socket.AF_INET else "::1"
        return asked(name if host == "localhost" else host, port, family, type)

    monkeypatch.setattr(socket, "getaddrinfo", told)
    link = opened(f"udpin:localhost:{free_port()}", ends)
    vehicle = ends.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    vehicle.sendto(b"hello", (LOCAL, port(link)))
    assert data(received(link)) == [b"hello"]


@pytest.mark.skipif(not IPV6, reason="this computer has no IPv6")
def test_links_support_ipv6_addresses(ends: ExitStack) -> None:
    link = opened(f"udpin:[::1]:{free_port()}", ends)
    assert isinstance(link, UdpLink)
    other = ends.enter_context(socket.socket(socket.AF_INET6, socket.SOCK_DGRAM))
    other.settimeout(TIMEOUT_S)
    other.sendto(b"hello", ("::1", port(link)))
    turns(link, lambda data: data == b"hello")
    peer = ("::1", other.getsockname()[1], 0, 0)
    link.follow(peer)
    link.send(b"answer", peer)
    assert other.recv(100) == b"answer"
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as third:
        third.sendto(b"x", ("::1", port(link)))
        turns(link, lambda _: link.report.ignored)
    assert "1 datagram from [::1]:" in link.report.news()[0]
    server = ends.enter_context(socket.create_server(("::1", 0), family=socket.AF_INET6))
    server.settimeout(TIMEOUT_S)
    stream = opened(f"tcp:[::1]:{server.getsockname()[1]}", ends)
    connection = ends.enter_context(server.accept()[0])
    connection.settimeout(TIMEOUT_S)
    stream.send(b"answer", None)
    assert connection.recv(100) == b"answer"


def test_missing_loopback_interface_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without it a socket can be bound, but nothing arrives. This is reported at once."""

    class Unreachable(socket.socket):
        def connect(self, _address: object, /) -> None:
            raise OSError(ENETUNREACH, "Network is unreachable")

    monkeypatch.setattr(socket, "socket", Unreachable)
    with pytest.raises(Unavailable, match="is the loopback interface up"):
        open_lockstep_link()
