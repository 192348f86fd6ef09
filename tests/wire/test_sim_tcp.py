"""The simulator as a TCP server, like ArduPilot's SITL."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from simulator.link.sockets import (
    UNSENT_MAX,
    LinkError,
    TcpLink,
    open_link,
    shifted,
    wait,
    whole_frames,
)

CODEC = mavlink.MAVLink(None, srcSystem=255)
HEARTBEAT = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(CODEC)
OLD = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(CODEC, force_mavlink1=True)


@pytest.fixture
def link() -> Iterator[TcpLink]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    opened = open_link(f"tcpin:127.0.0.1:{port}", 0)
    assert isinstance(opened, TcpLink)
    yield opened
    opened.close()


def client(link: TcpLink) -> socket.socket:
    connected = socket.create_connection(("127.0.0.1", link.port))
    connected.settimeout(2.0)
    assert heard(link) is None  # it is let in
    return connected


def heard(link: TcpLink) -> bytes | None:
    assert wait([link], 2.0) == [link]
    return link.receive()


def test_split_frames_are_joined_and_garbage_is_passed_on() -> None:
    stream = b"x" + HEARTBEAT + OLD + HEARTBEAT
    wholes = [0, 1, 1 + len(HEARTBEAT), 1 + len(HEARTBEAT + OLD), len(stream)]
    for length in range(len(stream) + 1):
        assert whole_frames(stream[:length]) == max(w for w in wholes if w <= length)


def test_clients_connect_and_disconnect(link: TcpLink) -> None:
    one, other = client(link), client(link)
    one.sendall(HEARTBEAT[:5])
    assert heard(link) is None
    one.sendall(HEARTBEAT[5:] + OLD)
    assert heard(link) == HEARTBEAT + OLD
    link.send([b"telemetry"])
    assert one.recv(100) == other.recv(100) == b"telemetry"
    one.close()
    assert heard(link) is None
    link.send([b"more"])
    assert other.recv(100) == b"more"
    with client(link) as again:
        link.send([b"again"])
        assert again.recv(100) == b"again"
    other.close()


def test_a_client_that_never_reads_is_disconnected(link: TcpLink) -> None:
    idle, other = client(link), client(link)
    piece, count = bytes(65536), 0
    for _ in range(20 * UNSENT_MAX // len(piece)):
        link.send([piece])
        count += len(other.recv(1 << 20))
    assert count > 15 * UNSENT_MAX
    left = 0
    while data := idle.recv(1 << 20):
        left += len(data)
    assert left < 15 * UNSENT_MAX  # and then the end
    idle.close()
    other.close()


def test_a_port_in_use_is_refused_and_instances_are_ten_apart(link: TcpLink) -> None:
    with pytest.raises(LinkError, match="cannot be opened"):
        open_link(f"tcpin:127.0.0.1:{link.port}", 0)
    assert shifted("tcpin:127.0.0.1:5760", 2) == "tcpin:127.0.0.1:5780"
    assert shifted("udpin:127.0.0.1:5760", 2) == "udpin:127.0.0.1:5762"
