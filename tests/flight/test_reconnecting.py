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
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import pytest

from offboard.link import clock
from offboard.link.connection import open_link
from offboard.link.interface import Link, LinkError
from offboard.link.stream import BROKEN, RENEWED
from offboard.link.udp import UdpLink

LONG_S = 10.0
TURN_S = 0.3  # for one turn of the loop, whatever the link does
IPV6 = socket.has_ipv6 and Path("/proc/net/if_inet6").exists()


@pytest.fixture
def keep() -> Iterator[Callable[[Link], Link]]:
    """Closes links after the test."""
    kept: list[Link] = []

    def one(link: Link) -> Link:
        kept.append(link)
        return link

    yield one
    for link in kept:
        link.close()


@contextmanager
def listening(port: int = 0) -> Iterator[socket.socket]:
    with socket.socket() as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        server.bind(("127.0.0.1", port))
        server.listen()
        server.settimeout(LONG_S)
        yield server


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


def broke(link: Link) -> bool:
    """Run the link until it tells that it broke."""
    news: list[str] = []

    def told(_: bytes) -> bool:
        news.extend(link.report.news())
        return BROKEN in news

    turns(link, told)
    return True


def test_a_tcp_peer_that_goes_and_returns_is_connected_again(
    keep: Callable[[Link], Link],
) -> None:
    with listening() as server:
        port = server.getsockname()[1]
        link = keep(open_link(f"tcp:127.0.0.1:{port}"))
        peer, _ = server.accept()
        peer.sendall(b"first")
        turns(link, lambda data: data == b"first")
        before = link.opened
        peer.close()
    assert broke(link)  # nobody listens now
    assert link.descriptors() == ()
    run(link, 0.7)
    with listening(port) as server:
        server.settimeout(0.0)
        accepted: list[socket.socket] = []

        def accepts(_: bytes) -> bool:
            try:
                accepted.append(server.accept()[0])
            except BlockingIOError:
                return False
            return True

        turns(link, accepts)
        accepted[0].sendall(b"again")
        turns(link, lambda data: data == b"again")
        assert link.report.news() == [RENEWED]
        assert link.opened > before
        accepted[0].settimeout(LONG_S)
        # what was sent meanwhile was dropped, not queued
        assert len(accepted[0].recv(65536)) < 12 * 30
        accepted[0].close()


def test_tcpin_takes_one_client_and_the_next_one_when_it_is_silent(
    keep: Callable[[Link], Link],
) -> None:
    link = keep(open_link("tcpin:127.0.0.1:0"))
    place = socket.socket(fileno=os.dup(link.descriptors()[0])).getsockname()
    assert link.receive(0.01) == []
    link.send(b"to nobody", None)
    with socket.create_connection(place) as vehicle:
        vehicle.sendall(b"one")
        assert turns(link, lambda data: data == b"one")
        link.follow("tcp")
        with socket.create_connection(place) as other:
            other.settimeout(LONG_S)

            def busy(_: bytes) -> bool:
                vehicle.sendall(b".")
                return any("connection from 127.0.0.1" in each for each in link.report.news())

            turns(link, busy)
            assert other.recv(10) == b""  # closed
        vehicle.settimeout(LONG_S)
        run(link, 0.6)
        with socket.create_connection(place) as back:  # and the first one has gone silently
            back.sendall(b"two")
            turns(link, lambda data: data.endswith(b"two"))
            while vehicle.recv(65536):
                pass
        assert broke(link)


def test_a_serial_device_that_is_unplugged_and_back(
    tmp_path: Path, keep: Callable[[Link], Link]
) -> None:
    device = tmp_path / "ttyACM0"

    def plug() -> tuple[int, int]:
        ours, theirs = pty.openpty()
        tty.setraw(theirs)
        device.symlink_to(os.ttyname(theirs))
        return ours, theirs

    ours, theirs = plug()
    link = keep(open_link(f"serial:{device}:57600"))
    os.write(ours, b"first")
    turns(link, lambda data: data == b"first")
    os.close(theirs)
    os.close(ours)
    device.unlink()
    assert broke(link)
    assert link.descriptors() == ()  # else the device would come back under another name
    ours, theirs = plug()
    turns(link, lambda _: link.descriptors())
    os.write(ours, b"again")
    turns(link, lambda data: data == b"again")
    os.close(theirs)
    os.close(ours)


@pytest.mark.parametrize("kind", ["tcp", "serial", "udp"])
def test_what_arrives_while_it_waits_is_not_read(kind: str, keep: Callable[[Link], Link]) -> None:
    """The supervisor has the same descriptors, and must find what the controller has waited for."""
    with ExitStack() as ends:
        link, send = joined(kind, ends)
        descriptor = keep(link).descriptors()[-1]
        assert waiting_bytes(descriptor) == 0
        began_s = clock.monotonic_s()
        later = threading.Timer(0.1, send, [b"\xfd while it waits"])
        later.start()
        link.wait(LONG_S)
        waited_s = clock.monotonic_s() - began_s
        later.join()
        assert 0.09 < waited_s < 0.09 + TURN_S
        assert waiting_bytes(descriptor) == 16
        link.wait(LONG_S)  # returns at once
        (chunk,) = link.receive(0.0)
        assert chunk.data == b"\xfd while it waits"
        assert began_s - 0.01 < chunk.arrived_s < clock.monotonic_s()
        assert link.receive(0.0) == []


def joined(kind: str, ends: ExitStack) -> tuple[Link, Callable[[bytes], object]]:
    """A link, and what sends on its other end."""
    if kind == "serial":
        ours, theirs = pty.openpty()
        tty.setraw(theirs)
        ends.callback(os.close, ours)
        ends.callback(os.close, theirs)
        return open_link(f"serial:{os.ttyname(theirs)}:57600"), partial(os.write, ours)
    if kind == "tcp":
        server = ends.enter_context(listening())
        link = open_link(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        return link, ends.enter_context(server.accept()[0]).sendall
    link = open_link("udpin:127.0.0.1:0")
    other = ends.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    assert isinstance(link, UdpLink)
    other.connect(("127.0.0.1", link.port))
    return link, other.send


def waiting_bytes(descriptor: int) -> int:
    """That nobody has read yet."""
    return int.from_bytes(fcntl.ioctl(descriptor, termios.FIONREAD, bytes(4)), sys.byteorder)


@pytest.mark.skipif(not IPV6, reason="this computer has no IPv6")
def test_ipv6_addresses(keep: Callable[[Link], Link]) -> None:
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as other:
        link = keep(open_link("udpin:[::1]:0"))
        assert isinstance(link, UdpLink)
        other.settimeout(LONG_S)
        other.sendto(b"hello", ("::1", link.port))
        turns(link, lambda data: data == b"hello")
        peer = ("::1", other.getsockname()[1], 0, 0)
        link.follow(peer)
        link.send(b"answer", peer)
        assert other.recv(100) == b"answer"
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as stranger:
            stranger.sendto(b"x", ("::1", link.port))
            turns(link, lambda _: link.report.ignored)
        assert "1 datagram from [::1]:" in link.report.news()[0]
    with socket.socket(socket.AF_INET6, socket.SOCK_STREAM) as server:
        server.settimeout(LONG_S)
        server.bind(("::1", 0))
        server.listen()
        link = keep(open_link(f"tcp:[::1]:{server.getsockname()[1]}"))
        with server.accept()[0] as connection:
            connection.settimeout(LONG_S)
            link.send(b"answer", None)
            assert connection.recv(100) == b"answer"
    with pytest.raises(LinkError, match=r"stands in brackets, as in udpin:\[::1\]:14540"):
        open_link("udpin:::1:14540")
