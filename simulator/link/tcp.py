"""TCP server of a link for any number of clients.

A TCP stream may cut a frame anywhere; `receive` returns whole MAVLink frames, as a datagram does.
"""

from __future__ import annotations

import selectors
import socket
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

CLIENTS_MAX = 16
READ_BYTES = 65536
UNSENT_MAX = 1 << 20  # bytes; a client that does not read more is disconnected
_MAGIC_V1, _MAGIC_V2, _SIGNED, _SIGNATURE_BYTES = 0xFE, 0xFD, 0x01, 13


@dataclass(slots=True)
class Client:
    """One connection: bytes received of an incomplete frame, and bytes not sent yet."""

    socket: socket.socket
    arrived: bytearray = field(default_factory=bytearray)
    unsent: bytearray = field(default_factory=bytearray)


class TcpLink:
    """A listening socket and its clients. A client that disconnects or does not read is dropped."""

    def __init__(self, listener: socket.socket) -> None:
        self._listener = listener
        self._clients: list[Client] = []
        self._selector = selectors.DefaultSelector()
        self._selector.register(listener, selectors.EVENT_READ)
        self._frames: deque[bytes] = deque()

    def fileno(self) -> int:
        """File descriptor for select; it covers the listener and all clients."""
        fileno = getattr(self._selector, "fileno", self._listener.fileno)
        return int(fileno())

    @property
    def port(self) -> int:
        """The local port."""
        return int(self._listener.getsockname()[1])

    def send(self, datagrams: Iterable[bytes]) -> None:
        """Send all datagrams to every client."""
        together = b"".join(datagrams)
        for client in tuple(self._clients):
            client.unsent += together
            if client.unsent:
                self._flush(client)

    def _flush(self, client: Client) -> None:
        try:
            del client.unsent[: client.socket.send(client.unsent)]
        except BlockingIOError:
            pass
        except OSError:
            self._disconnect(client)
        if len(client.unsent) > UNSENT_MAX:
            self._disconnect(client)

    def receive(self) -> bytes | None:
        """Whole frames of one read from one client, or None."""
        if not self._frames:
            for key, _ in self._selector.select(0):
                if key.fileobj is self._listener:
                    self._accept()
                else:
                    self._read_client(key.data)
        return self._frames.popleft() if self._frames else None

    def _accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except OSError:
            return
        if len(self._clients) >= CLIENTS_MAX:
            self._disconnect(self._clients[0])
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = Client(sock)
        self._clients.append(client)
        self._selector.register(sock, selectors.EVENT_READ, client)

    def _read_client(self, client: Client) -> None:
        try:
            piece = client.socket.recv(READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            piece = b""
        if not piece:
            self._disconnect(client)
            return
        client.arrived += piece
        whole = whole_frames(client.arrived)
        if whole:
            self._frames.append(bytes(client.arrived[:whole]))
            del client.arrived[:whole]

    def _disconnect(self, client: Client) -> None:
        if client in self._clients:
            self._clients.remove(client)
            self._selector.unregister(client.socket)
            client.socket.close()

    def close(self) -> None:
        for client in tuple(self._clients):
            self._disconnect(client)
        self._selector.close()
        self._listener.close()


def whole_frames(data: bytes | bytearray) -> int:
    """Number of bytes before the first incomplete frame; bytes outside frames count too."""
    at = 0
    while at < len(data):
        length = 1
        if data[at] in (_MAGIC_V1, _MAGIC_V2):
            if len(data) - at < 3:
                return at
            length = data[at + 1] + (8 if data[at] == _MAGIC_V1 else 12)
            if data[at] == _MAGIC_V2 and data[at + 2] & _SIGNED:
                length += _SIGNATURE_BYTES
            if at + length > len(data):
                return at
        at += length
    return at
