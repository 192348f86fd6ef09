"""UDP ends of the simulator's links. Bytes only; no MAVLink and no waiting beyond `wait`.

udpout:HOST:PORT sends to that address from the start, udpin:HOST:PORT waits to be spoken to.
Whoever sends to the socket is a peer from then on.
"""

from __future__ import annotations

import select
import socket
from collections.abc import Iterable, Sequence

PEERS_MAX = 16
DATAGRAM_MAX = 65535
Address = tuple[str, int]


class LinkError(Exception):
    """An address that cannot be used: one sentence."""


class UdpLink:
    """One socket and its peers. A peer that refuses or a full buffer loses datagrams, no more."""

    def __init__(self, sock: socket.socket, target: Address | None) -> None:
        self._socket = sock
        self._target = target
        self._peers: dict[Address, None] = {} if target is None else {target: None}

    def fileno(self) -> int:
        return self._socket.fileno()

    @property
    def port(self) -> int:
        """The local port."""
        return int(self._socket.getsockname()[1])

    def send(self, datagrams: Iterable[bytes]) -> None:
        """Each datagram to every peer."""
        for datagram in datagrams:
            for peer in self._peers:
                try:
                    self._socket.sendto(datagram, peer)
                except OSError:  # refused, unreachable or full: telemetry may be lost
                    continue

    def receive(self) -> bytes | None:
        """One datagram, or None when none waits."""
        while True:
            try:
                datagram, sender = self._socket.recvfrom(DATAGRAM_MAX)
            except ConnectionError:
                continue  # an ICMP answer to something sent earlier
            except OSError:
                return None
            if sender not in self._peers:
                self._learn(sender)
            return datagram

    def _learn(self, sender: Address) -> None:
        if len(self._peers) >= PEERS_MAX:
            oldest = next(peer for peer in self._peers if peer != self._target)
            del self._peers[oldest]
        self._peers[sender] = None

    def close(self) -> None:
        self._socket.close()


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


def wait(links: Sequence[UdpLink], timeout_s: float) -> list[UdpLink]:
    """The links at which a datagram waits, as soon as there is one, at the latest `timeout_s`."""
    return select.select(links, [], [], max(0.0, timeout_s))[0]


def open_link(url: str, preferred_port: int) -> UdpLink:
    """Open `udpout:HOST:PORT` (from `preferred_port` if it is free) or `udpin:HOST:PORT`.

    Raises LinkError with a sentence.
    """
    kind, host, port = _split(url)
    address = _resolve(url, host, port)
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setblocking(False)
    try:
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
    """The same link `by` ports further on. Raises LinkError with a sentence."""
    kind, host, port = _split(url)
    return f"{kind}:{host}:{port + by}"


def _split(url: str) -> tuple[str, str, int]:
    parts = url.split(":")
    usable = len(parts) == 3 and parts[0] in ("udpout", "udpin") and parts[1] != ""
    if not (usable and parts[2].isascii() and parts[2].isdigit() and 0 < int(parts[2]) < 65536):
        raise LinkError(
            f"{url} is no link: give udpout:HOST:PORT or udpin:HOST:PORT, port 1 .. 65535"
        )
    return parts[0], parts[1], int(parts[2])


def _resolve(url: str, host: str, port: int) -> Address:
    try:
        found = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)
    except (OSError, UnicodeError):
        raise LinkError(f"{url} cannot be opened: no address known for {host}") from None
    address = found[0][4]
    return (str(address[0]), int(address[1]))
