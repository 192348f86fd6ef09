"""UDP socket of a link: every address that sends to it becomes a peer."""

from __future__ import annotations

import socket
from collections.abc import Iterable

PEERS_MAX = 16
DATAGRAM_MAX = 65535
Address = tuple[str, int]


class UdpLink:
    """One socket and its peers. Send errors lose datagrams and are otherwise ignored."""

    def __init__(self, sock: socket.socket, target: Address | None) -> None:
        self._socket = sock
        self._target = target
        self._peers: dict[Address, None] = {} if target is None else {target: None}

    def beside(self) -> UdpLink:
        """A link with another port of the same host, and the same peers."""
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.setblocking(False)
        sock.bind((self._socket.getsockname()[0], 0))
        other = UdpLink(sock, None)
        other._peers = self._peers
        return other

    def fileno(self) -> int:
        return self._socket.fileno()

    @property
    def port(self) -> int:
        """The local port."""
        return int(self._socket.getsockname()[1])

    def send(self, datagrams: Iterable[bytes]) -> None:
        """Send each datagram to every peer."""
        for datagram in datagrams:
            for peer in self._peers:
                try:
                    self._socket.sendto(datagram, peer)
                except OSError:  # refused, unreachable or full: telemetry may be lost
                    continue

    def receive(self) -> bytes | None:
        """One datagram, or None."""
        while True:
            try:
                datagram, sender = self._socket.recvfrom(DATAGRAM_MAX)
            except ConnectionError:
                continue  # ICMP error for a datagram sent earlier
            except OSError:
                return None
            if sender not in self._peers:
                self._add_peer(sender)
            return datagram

    def _add_peer(self, sender: Address) -> None:
        if len(self._peers) >= PEERS_MAX:
            oldest = next(peer for peer in self._peers if peer != self._target)
            del self._peers[oldest]
        self._peers[sender] = None

    def close(self) -> None:
        self._socket.close()
