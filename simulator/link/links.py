"""Opening the simulator's links, and waiting for datagrams. Bytes only; no MAVLink.

udpout:HOST:PORT sends to that address from the start, udpin:HOST:PORT answers every address that
sends to it, and tcpin:HOST:PORT accepts connections, as ArduPilot's SITL does.
"""

from __future__ import annotations

import select
import socket
from collections.abc import Iterable, Sequence
from typing import Protocol

from offboard.documents.errors import abridged
from simulator.link.tcp import TcpLink
from simulator.link.udp import Address, UdpLink

# Distance between the ports of two instances, as PX4 and ArduPilot have it
_PORTS_APART = {"udpout": 1, "udpin": 1, "tcpin": 10}


class LinkError(Exception):
    """An address that cannot be used; the message is one sentence."""


class Link(Protocol):
    """One end of a link with any number of peers. No method blocks."""

    @property
    def port(self) -> int: ...
    def fileno(self) -> int: ...
    def send(self, datagrams: Iterable[bytes]) -> None: ...
    def receive(self) -> bytes | None: ...
    def close(self) -> None: ...


def free_ports(count: int) -> list[int]:
    """UDP ports on 127.0.0.1 that are free now."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    try:
        for sock in sockets:
            sock.bind(("127.0.0.1", 0))
        return [int(sock.getsockname()[1]) for sock in sockets]
    finally:
        for sock in sockets:
            sock.close()


def wait(links: Sequence[Link], timeout_s: float) -> list[Link]:
    """Links with a datagram to receive; returns with the first one, or after `timeout_s`."""
    return select.select(links, [], [], max(0.0, timeout_s))[0]


def open_link(url: str, preferred_port: int) -> Link:
    """Open a link.

    Args:
        url: `udpout:HOST:PORT`, `udpin:HOST:PORT` or `tcpin:HOST:PORT`.
        preferred_port: local port of `udpout`; any other if it is in use.

    Raises:
        LinkError: the address is malformed, unknown or in use.
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


def open_beside(link: Link) -> Link:
    """Open a link with a port of its own and the same peers, for a sender beside the vehicle.

    Raises:
        LinkError: the link is a connection, in which nobody else can send.
    """
    if not isinstance(link, UdpLink):
        raise LinkError("fault stranger: it needs a UDP link, where another port can send")
    return link.beside()


def shifted(url: str, by: int) -> str:
    """URL of the same link for the instance `by` numbers later. Raises LinkError."""
    kind, host, port = _split(url)
    return f"{kind}:{host}:{port + by * _PORTS_APART[kind]}"


def _split(url: str) -> tuple[str, str, int]:
    parts = url.split(":")
    usable = len(parts) == 3 and parts[0] in _PORTS_APART and parts[1] != ""
    number = parts[-1].isascii() and parts[-1].isdigit() and len(parts[-1]) <= 5
    if not (usable and number and 0 < int(parts[2]) < 65536):
        raise LinkError(
            f"{abridged(url)} is not a link: give udpout:, udpin: or tcpin:HOST:PORT, "
            "port 1 .. 65535"
        )
    return parts[0], parts[1], int(parts[2])


def _resolve(url: str, host: str, port: int) -> Address:
    try:
        found = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)
    except (OSError, UnicodeError):
        raise LinkError(
            f"{abridged(url)} cannot be opened: no address known for {abridged(host)}"
        ) from None
    address = found[0][4]
    return (str(address[0]), int(address[1]))
