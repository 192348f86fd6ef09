"""Byte links: UDP, TCP and serial behind one small contract. Of MAVLink they know setpoints by id.

udpin:HOST:PORT    wait on a port; the peer is whoever the session accepts
udpout:HOST:PORT   send to a fixed peer
tcp:HOST:PORT      connect to a listening autopilot (ArduPilot SITL)
serial:DEVICE:BAUD
"""

from __future__ import annotations

import os
import select
import socket
from collections.abc import Callable, Hashable
from contextlib import suppress
from typing import Protocol

from offboard.documents.errors import UserError

Chunk = tuple[bytes, Hashable]
DATAGRAM_SIZE = 65535
WAITING_MAX = 50  # frames
SETPOINTS = frozenset({82, 84, 86})  # SET_ATTITUDE_TARGET, SET_POSITION_TARGET_*
TCP_NOTSENT_LOWAT = 25  # Linux's option, which the socket module names since Python 3.12


class LinkError(UserError):
    """A link that cannot be opened or was lost: one sentence for the user."""


class Link(Protocol):
    """Non-blocking byte channel; `is_stream` says that chunks do not end at frame borders."""

    is_stream: bool

    def receive(self, timeout_s: float) -> list[Chunk]:
        """All chunks that wait, after waiting at most `timeout_s` for the first."""
        ...

    def send(self, data: bytes, peer: Hashable | None) -> None:
        """Send one frame to `peer` (UDP) or the only other end. Never waits: what does not fit is
        dropped, or kept a while where a part of a frame would spoil the stream."""
        ...

    def close(self) -> None: ...


class UdpLink:
    """One UDP socket. `peer` is fixed for udpout, learned by the caller for udpin."""

    is_stream = False

    def __init__(self, sock: socket.socket, peer: tuple[str, int] | None) -> None:
        self._socket = sock
        self._peer = peer

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
        with suppress(OSError):  # silence tells of a dead link
            self._socket.sendto(data, target)

    def close(self) -> None:
        self._socket.close()

    @property
    def port(self) -> int:
        """The local port, for whoever asked for port 0."""
        return int(self._socket.getsockname()[1])


class Backlog:
    """Whole frames that wait for room in a stream. A setpoint takes the place of the one that
    waits, for an old one is worse than none; of too many frames the oldest are given up."""

    def __init__(self) -> None:
        self._begun = b""
        self._waiting: list[bytes] = []

    def add(self, frame: bytes) -> None:
        if _is_setpoint(frame):
            self._waiting = [other for other in self._waiting if not _is_setpoint(other)]
        self._waiting = [*self._waiting, frame][-WAITING_MAX:]

    def flush(self, send: Callable[[bytes], int]) -> None:
        """Send what goes; `send` returns how many bytes went, or raises as sockets do."""
        with suppress(BlockingIOError):
            while self._begun or self._waiting:
                if not self._begun:
                    self._begun = self._waiting.pop(0)
                self._begun = self._begun[send(self._begun) :]


def _is_setpoint(frame: bytes) -> bool:
    return int.from_bytes(frame[7:10], "little") in SETPOINTS


class TcpLink:
    """A TCP connection to an autopilot that listens."""

    is_stream = True

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        with suppress(OSError):  # what waits shall wait here, where it can still be replaced
            sock.setsockopt(socket.IPPROTO_TCP, TCP_NOTSENT_LOWAT, 1)
        self._socket = sock
        self._open = True
        self._backlog = Backlog()

    def receive(self, timeout_s: float) -> list[Chunk]:
        if not self._open:
            select.select([], [], [], max(0.0, timeout_s))
            return []
        self._flush()
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
        self._backlog.add(data)
        self._flush()

    def _flush(self) -> None:
        with suppress(OSError):  # silence tells of a dead link
            self._backlog.flush(self._socket.send)

    def close(self) -> None:
        self._socket.close()


class SerialLink:
    """A serial port through pyserial."""

    is_stream = True

    def __init__(self, device: str, baud: int) -> None:
        import serial

        try:
            self._port = serial.Serial(device, baud, timeout=0)
        except (serial.SerialException, ValueError) as error:
            raise LinkError(
                f"serial port {device} at {baud} baud cannot be opened: {error}"
            ) from None
        self._backlog = Backlog()

    def receive(self, timeout_s: float) -> list[Chunk]:
        self._flush()
        try:
            self._port.timeout = max(0.0, timeout_s)
            first = self._port.read(1)
            data = first + self._port.read(self._port.in_waiting) if first else b""
        except OSError:  # unplugged, which pyserial tells in more than one way
            select.select([], [], [], max(0.0, timeout_s))
            return []
        return [(data, "serial")] if data else []

    def send(self, data: bytes, peer: Hashable | None) -> None:
        self._backlog.add(data)
        self._flush()

    def _flush(self) -> None:
        with suppress(OSError):  # silence tells of a dead link
            self._backlog.flush(self._write)

    def _write(self, data: bytes) -> int:
        # pyserial's own write spins until a full port has room again
        return os.write(self._port.fileno(), data)

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
