"""The UDP end of a link: whoever sends to the socket is a peer from then on."""

from __future__ import annotations

import socket
from collections.abc import Iterable

PEERS_MAX = 16
DATAGRAM_MAX = 65535
Address = tuple[str, int]


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
