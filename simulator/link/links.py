"""Opening the simulator's links, and waiting for them. Bytes only; no MAVLink.

udpout:HOST:PORT sends to that address from the start, udpin:HOST:PORT waits to be spoken to, and
tcpin:HOST:PORT to be connected to, as ArduPilot's SITL does.
"""

from __future__ import annotations

import select
import socket
from collections.abc import Iterable, Sequence
from typing import Protocol

from simulator.link.tcp import TcpLink
from simulator.link.udp import Address, UdpLink

# Of instances, as those of PX4 and ArduPilot are
_PORTS_APART = {"udpout": 1, "udpin": 1, "tcpin": 10}


class LinkError(Exception):
    """An address that cannot be used: one sentence."""


class Link(Protocol):
    """One end of a link, with any number of peers. Nothing here waits."""

    @property
    def port(self) -> int: ...
    def fileno(self) -> int: ...
    def send(self, datagrams: Iterable[bytes]) -> None: ...
    def receive(self) -> bytes | None: ...
    def close(self) -> None: ...


def free_ports(count: int) -> list[int]:
    """UDP ports that nobody used a moment ago."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    try:
        for sock in sockets:
            sock.bind(("127.0.0.1", 0))
        return [int(sock.getsockname()[1]) for sock in sockets]
    finally:
        for sock in sockets:
            sock.close()


def wait(links: Sequence[Link], timeout_s: float) -> list[Link]:
    """The links at which a datagram waits, as soon as there is one, at the latest `timeout_s`."""
    return select.select(links, [], [], max(0.0, timeout_s))[0]


def open_link(url: str, preferred_port: int) -> Link:
    """Open `udpout:HOST:PORT` (from `preferred_port` if it is free), `udpin:` or `tcpin:` alike.

    Raises LinkError with a sentence.
    """
    kind, host, port = _split(url)
    address = _resolve(url, host, port)
    by_stream = kind == "tcpin"
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM if by_stream else socket.SOCK_DGRAM)
    sock.setblocking(False)
    try:
        if by_stream:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind(address)
            sock.listen()
            return TcpLink(sock)
        if kind == "udpin":
            sock.bind(address)
            return UdpLink(sock, None)
        local = "127.0.0.1" if address[0].startswith("127.") else ""
        try:
            sock.bind((local, preferred_port))
        except OSError:
            sock.bind((local, 0))
    except OSError as error:
        sock.close()
        raise LinkError(f"{url} cannot be opened: {error.strerror or error}") from None
    return UdpLink(sock, address)


def shifted(url: str, by: int) -> str:
    """The same link of the instance `by` further on. Raises LinkError with a sentence."""
    kind, host, port = _split(url)
    return f"{kind}:{host}:{port + by * _PORTS_APART[kind]}"


def _split(url: str) -> tuple[str, str, int]:
    parts = url.split(":")
    usable = len(parts) == 3 and parts[0] in _PORTS_APART and parts[1] != ""
    if not (usable and parts[2].isascii() and parts[2].isdigit() and 0 < int(parts[2]) < 65536):
        raise LinkError(
            f"{url} is no link: give udpout:, udpin: or tcpin:HOST:PORT, port 1 .. 65535"
        )
    return parts[0], parts[1], int(parts[2])


def _resolve(url: str, host: str, port: int) -> Address:
    try:
        found = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)
    except (OSError, UnicodeError):
        raise LinkError(f"{url} cannot be opened: no address known for {host}") from None
    address = found[0][4]
    return (str(address[0]), int(address[1]))
