"""Links that break and come back, on real sockets and pseudo-terminals; addresses of IPv6."""

from __future__ import annotations

import fcntl
import os
import pty
import socket
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path

import pytest

from offboard.link import clock
from offboard.link.connection import open_link
from offboard.link.interface import Link, LinkError
from offboard.link.stream import BROKEN, RENEWED
from offboard.link.udp import UdpLink

LONG_S = 10.0
TURN_S = 1.0  # for one turn of the loop, whatever the link does, on a busy machine
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
    server.settimeout(LONG_S)
    return server


def plugged(ends: ExitStack) -> tuple[int, str, Callable[[], object]]:
    """A serial device: the descriptor of its other end, its path, and what unplugs it."""
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    unplugs = ends.enter_context(ExitStack())
    unplugs.callback(os.close, ours)
    unplugs.callback(os.close, theirs)
    return ours, os.ttyname(theirs), unplugs.close


def turns(link: Link, until: Callable[[bytes], object]) -> bytes:
    """Turns of the loop until `until` holds for all that was received; none of them may wait."""
    received, deadline_s = b"", time.monotonic() + LONG_S
    while not until(received):
        began_s = time.monotonic()
        assert began_s < deadline_s, received
        received += b"".join(chunk.data for chunk in link.receive(0.02))
        link.send(b"\xfd\0\0\0\0\0\0\0\0\0\0\0", None)
        assert time.monotonic() - began_s < TURN_S
    return received


def run(link: Link, seconds: float) -> None:
    end_s = time.monotonic() + seconds
    turns(link, lambda _: time.monotonic() > end_s)


def run_until_it_breaks(link: Link) -> None:
    turns(link, lambda _: BROKEN in link.report.news())


def test_a_tcp_peer_that_goes_and_returns_is_connected_again(ends: ExitStack) -> None:
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
    peer.settimeout(LONG_S)
    peer.sendall(b"again")
    turns(link, lambda data: data == b"again")
    assert link.report.news() == [RENEWED]
    assert link.opened > before
    after = peer.recv(65536)
    assert len(after) < 12 * 30  # what was sent meanwhile was dropped, not queued
    assert b"old" not in after


def test_tcpin_takes_one_client_and_the_next_one_when_it_is_silent(ends: ExitStack) -> None:
    link = opened("tcpin:127.0.0.1:0", ends)
    place = socket.socket(fileno=os.dup(link.descriptors()[0])).getsockname()
    assert link.receive(0.01) == []
    link.send(b"to nobody", None)
    vehicle = ends.enter_context(socket.create_connection(place))
    vehicle.settimeout(LONG_S)
    vehicle.sendall(b"one")
    turns(link, lambda data: data == b"one")
    link.follow("tcp")
    with socket.create_connection(place) as other:
        other.settimeout(LONG_S)

        def refused(_: bytes) -> bool:
            vehicle.sendall(b".")
            return any("connection from 127.0.0.1" in each for each in link.report.news())

        turns(link, refused)
        assert other.recv(10) == b""  # closed
    run(link, 0.6)
    with socket.create_connection(place) as back:  # and the first one has gone silently
        back.sendall(b"two")
        turns(link, lambda data: data.endswith(b"two"))
        while vehicle.recv(65536):
            pass
    run_until_it_breaks(link)


def test_a_serial_device_that_is_unplugged_and_back(tmp_path: Path, ends: ExitStack) -> None:
    device = tmp_path / "ttyACM0"
    other_end, path, unplug = plugged(ends)
    device.symlink_to(path)
    link = opened(f"serial:{device}:57600", ends)
    os.write(other_end, b"first")
    turns(link, lambda data: data == b"first")
    unplug()
    device.unlink()
    run_until_it_breaks(link)
    assert link.descriptors() == ()  # else the device would come back under another name
    other_end, path, _ = plugged(ends)
    device.symlink_to(path)
    turns(link, lambda _: link.descriptors())
    os.write(other_end, b"again")
    turns(link, lambda data: data == b"again")


@pytest.mark.parametrize("kind", ["tcp", "serial", "udp"])
def test_what_arrives_while_it_waits_is_not_read(kind: str, ends: ExitStack) -> None:
    """The supervisor has the same descriptors, and must find what the controller has waited for."""
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
    link.wait(LONG_S)
    waited_s = clock.monotonic_s() - began_s
    later.join()
    assert 0.09 < waited_s < 0.09 + TURN_S
    assert waiting_bytes(descriptor) == 16
    link.wait(LONG_S)  # returns at once
    (chunk,) = link.receive(0.0)
    assert chunk.data == b"\xfd while it waits"
    assert sent_s[0] - 1e-4 < chunk.arrived_s < clock.monotonic_s()
    assert link.receive(0.0) == []


def joined(kind: str, ends: ExitStack) -> tuple[Link, Callable[[bytes], object]]:
    """A link, and what sends on its other end."""
    if kind == "serial":
        other_end, path, _ = plugged(ends)
        return opened(f"serial:{path}:57600", ends), partial(os.write, other_end)
    if kind == "tcp":
        server = listening(ends)
        link = opened(f"tcp:127.0.0.1:{server.getsockname()[1]}", ends)
        return link, ends.enter_context(server.accept()[0]).sendall
    link = opened("udpin:127.0.0.1:0", ends)
    other = ends.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    assert isinstance(link, UdpLink)
    other.connect(("127.0.0.1", link.port))
    return link, other.send


def waiting_bytes(descriptor: int) -> int:
    """That nobody has read yet."""
    return int.from_bytes(fcntl.ioctl(descriptor, termios.FIONREAD, bytes(4)), sys.byteorder)


@pytest.mark.skipif(not IPV6, reason="this computer has no IPv6")
def test_ipv6_addresses(ends: ExitStack) -> None:
    link = opened("udpin:[::1]:0", ends)
    assert isinstance(link, UdpLink)
    other = ends.enter_context(socket.socket(socket.AF_INET6, socket.SOCK_DGRAM))
    other.settimeout(LONG_S)
    other.sendto(b"hello", ("::1", link.port))
    turns(link, lambda data: data == b"hello")
    peer = ("::1", other.getsockname()[1], 0, 0)
    link.follow(peer)
    link.send(b"answer", peer)
    assert other.recv(100) == b"answer"
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as third:
        third.sendto(b"x", ("::1", link.port))
        turns(link, lambda _: link.report.ignored)
    assert "1 datagram from [::1]:" in link.report.news()[0]
    server = ends.enter_context(socket.create_server(("::1", 0), family=socket.AF_INET6))
    server.settimeout(LONG_S)
    stream = opened(f"tcp:[::1]:{server.getsockname()[1]}", ends)
    connection = ends.enter_context(server.accept()[0])
    connection.settimeout(LONG_S)
    stream.send(b"answer", None)
    assert connection.recv(100) == b"answer"
    with pytest.raises(LinkError, match=r"stands in brackets, as in udpin:\[::1\]:14540"):
        open_link("udpin:::1:14540")
