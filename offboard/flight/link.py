"""Byte links: UDP, TCP and serial behind one small contract. No MAVLink here.

udpin:HOST:PORT    wait on a port; the peer is whoever the session accepts
udpout:HOST:PORT   send to a fixed peer
tcp:HOST:PORT      connect to a listening autopilot (ArduPilot SITL)
serial:DEVICE:BAUD
"""

from __future__ import annotations

import select
import socket
from collections.abc import Hashable
from typing import Protocol

Chunk = tuple[bytes, Hashable]
DATAGRAM_SIZE = 65535


class LinkError(Exception):
    """A link that cannot be opened or was lost: one sentence for the user."""


class Link(Protocol):
    """Non-blocking byte channel; `is_stream` says that chunks do not end at frame borders."""

    is_stream: bool

    def receive(self, timeout_s: float) -> list[Chunk]:
        """All chunks that wait, after waiting at most `timeout_s` for the first."""
        ...

    def send(self, data: bytes, peer: Hashable | None) -> None:
        """Send to `peer` (UDP) or the only other end. A full or refused link drops, uncounted."""
        ...

    def close(self) -> None: ...


class UdpLink:
    """One UDP socket. `peer` is fixed for udpout, learned by the caller for udpin."""

    is_stream = False

    def __init__(self, sock: socket.socket, peer: tuple[str, int] | None) -> None:
        self._socket = sock
        self._peer = peer
        self.send_errors = 0

    def receive(self, timeout_s: float) -> list[Chunk]:
        ready, _, _ = select.select([self._socket], [], [], max(0.0, timeout_s))
        chunks: list[Chunk] = []
        while ready:
            try:
                chunks.append(self._socket.recvfrom(DATAGRAM_SIZE))
            except ConnectionError:
                continue  # the peer's port is closed: an ICMP answer to an earlier datagram
            except OSError:
                break  # nothing waits, or the interface went away
        return chunks

    def send(self, data: bytes, peer: Hashable | None) -> None:
        target = self._peer or peer
        if not isinstance(target, tuple):
            return
        try:
            self._socket.sendto(data, target)
        except OSError:
            self.send_errors += 1

    def close(self) -> None:
        self._socket.close()

    @property
    def port(self) -> int:
        """The local port, for whoever asked for port 0."""
        return int(self._socket.getsockname()[1])


class TcpLink:
    """A TCP connection to an autopilot that listens."""

    is_stream = True

    def __init__(self, sock: socket.socket) -> None:
        self._socket = sock
        self._open = True
        self.send_errors = 0

    def receive(self, timeout_s: float) -> list[Chunk]:
        if not self._open:
            select.select([], [], [], max(0.0, timeout_s))
            return []
        ready, _, _ = select.select([self._socket], [], [], max(0.0, timeout_s))
        if not ready:
            return []
        try:
            data = self._socket.recv(DATAGRAM_SIZE)
        except (BlockingIOError, InterruptedError):
            return []
        except OSError:
            data = b""
        self._open = bool(data)
        return [(data, "tcp")] if data else []

    def send(self, data: bytes, peer: Hashable | None) -> None:
        try:
            self._socket.sendall(data)
        except OSError:
            self.send_errors += 1

    def close(self) -> None:
        self._socket.close()


class SerialLink:
    """A serial port through pyserial."""

    is_stream = True

    def __init__(self, device: str, baud: int) -> None:
        import serial

        try:
            self._port = serial.Serial(device, baud, timeout=0, write_timeout=0.05)
        except (serial.SerialException, ValueError) as error:
            raise LinkError(
                f"serial port {device} at {baud} baud cannot be opened: {error}"
            ) from None
        self.send_errors = 0

    def receive(self, timeout_s: float) -> list[Chunk]:
        try:
            self._port.timeout = max(0.0, timeout_s)
            first = self._port.read(1)
            data = first + self._port.read(self._port.in_waiting) if first else b""
        except OSError:  # unplugged, which pyserial tells in more than one way
            select.select([], [], [], max(0.0, timeout_s))
            return []
        return [(data, "serial")] if data else []

    def send(self, data: bytes, peer: Hashable | None) -> None:
        try:
            self._port.write(data)
        except OSError:
            self.send_errors += 1

    def close(self) -> None:
        self._port.close()


def open_link(address: str) -> Link:
    """Open `address` (see the module's first lines); LinkError says what to change."""
    kind, _, rest = address.partition(":")
    host, _, tail = rest.rpartition(":")
    if kind not in ("udpin", "udpout", "tcp", "serial") or not host or not tail.isdigit():
        raise LinkError(
            f"connection {address!r} is not understood; use udpin:HOST:PORT, udpout:HOST:PORT, "
            "tcp:HOST:PORT or serial:DEVICE:BAUD"
        )
    number = int(tail)
    if kind == "serial":
        return SerialLink(host, number)
    if not 0 <= number <= 65535:
        raise LinkError(f"connection {address!r}: port {number} is not within 0 .. 65535")
    return _open_socket(kind, host, number, address)


def _open_socket(kind: str, host: str, port: int, address: str) -> Link:
    try:
        if kind == "tcp":
            connection = socket.create_connection((host, port), timeout=5.0)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.settimeout(1.0)
            return TcpLink(connection)
        peer = (socket.gethostbyname(host), port)
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        sock.setblocking(False)
        if kind == "udpout":
            return UdpLink(sock, peer)
        sock.bind(peer)
    except OSError as error:
        raise LinkError(
            f"connection {address} cannot be opened: {error.strerror or error}"
            + ("; another program uses the port" if getattr(error, "errno", 0) == 98 else "")
        ) from None
    return UdpLink(sock, None)
