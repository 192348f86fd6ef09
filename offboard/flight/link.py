"""Links: UDP, TCP and serial behind one protocol. Of MAVLink they know only message ids.

udpin:HOST:PORT    listen on a port, send to the address of the vehicle that the session found
udpout:HOST:PORT   send to this address
tcp:HOST:PORT      connect to a listening autopilot (ArduPilot SITL)
serial:DEVICE:BAUD
"""

from __future__ import annotations

import os
import select
import socket
from collections.abc import Hashable
from contextlib import suppress
from typing import Protocol

from offboard.documents.errors import UserError, abridged, shown
from offboard.mavlink.framing import frame_size

Chunk = tuple[bytes, Hashable]
DATAGRAM_SIZE = 65535
QUEUED_MAX = 50  # frames
SETPOINTS = frozenset({82, 84, 86})  # SET_ATTITUDE_TARGET, SET_POSITION_TARGET_*
TIMESYNC = 111
TCP_NOTSENT_LOWAT = 25  # Linux's option, which the socket module names since Python 3.12


class LinkError(UserError):
    """A link that cannot be opened or was lost: one sentence for the user."""


class Link(Protocol):
    """Non-blocking byte channel. `is_stream`: received chunks may end within a frame."""

    is_stream: bool

    def receive(self, timeout_s: float) -> list[Chunk]:
        """All received chunks, after waiting at most `timeout_s` for the first."""
        ...

    def send(self, data: bytes, peer: Hashable | None) -> None:
        """Send one frame to `peer` (UDP) or to the other end. Never waits: a frame that does not
        fit into the buffer is dropped (UDP) or queued (streams)."""
        ...

    def close(self) -> None: ...


class UdpLink:
    """One UDP socket. `peer` is fixed for udpout and None for udpin."""

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
                continue  # ICMP: the peer's port was closed when an earlier datagram arrived
            except OSError:
                break  # nothing left, or the network interface is down
        return chunks

    def send(self, data: bytes, peer: Hashable | None) -> None:
        target = self._peer or peer
        if not isinstance(target, tuple):
            return
        with suppress(OSError):  # a dead link shows as silence
            self._socket.sendto(data, target)

    def close(self) -> None:
        self._socket.close()

    @property
    def port(self) -> int:
        """The local port."""
        return int(self._socket.getsockname()[1])


class LockstepLink(UdpLink):
    """UDP to a simulator in lockstep: returns all datagrams up to a barrier at once, and only once.

    A barrier is a TIMESYNC request at the end of a datagram. The simulator waits for the reply and
    meanwhile repeats all datagrams since the previous barrier.
    """

    def __init__(self, sock: socket.socket, peer: tuple[str, int] | None) -> None:
        super().__init__(sock, peer)
        self._block: list[Chunk] = []  # since the newest barrier
        self._barrier = b""

    def receive(self, timeout_s: float) -> list[Chunk]:
        complete: list[Chunk] = []
        for chunk in super().receive(timeout_s):
            self._block.append(chunk)
            if _is_barrier(chunk[0]):
                if chunk[0] != self._barrier:
                    complete += self._block
                self._barrier, self._block = chunk[0], []
        return complete


def _message_id(frame: bytes) -> int:
    """Message id of a MAVLink 2 frame."""
    return int.from_bytes(frame[7:10], "little")


def _is_setpoint(frame: bytes) -> bool:
    return _message_id(frame) in SETPOINTS


def _is_barrier(datagram: bytes) -> bool:
    """Whether the last frame is a TIMESYNC request, which has tc1 = 0."""
    at = last = 0
    while at < len(datagram):
        last, at = at, at + (frame_size(datagram, at) or len(datagram))
    return _message_id(datagram[last:]) == TIMESYNC and not any(datagram[last + 10 : last + 18])


class StreamLink:
    """Base of TCP and serial links. Frames are queued while the buffer of the stream is full: a new
    setpoint replaces a queued one, and of too many frames the oldest are dropped."""

    is_stream = True

    def __init__(self) -> None:
        self._begun = b""
        self._queued: list[bytes] = []

    def send(self, data: bytes, peer: Hashable | None) -> None:
        if _is_setpoint(data):
            self._queued = [other for other in self._queued if not _is_setpoint(other)]
        self._queued = [*self._queued, data][-QUEUED_MAX:]
        self._flush()

    def _flush(self) -> None:
        """Send as much as possible. A dead link shows as silence."""
        with suppress(OSError):
            while self._begun or self._queued:
                if not self._begun:
                    self._begun = self._queued.pop(0)
                self._begun = self._begun[self._write(self._begun) :]

    def _write(self, data: bytes) -> int:
        """Number of bytes sent; raises BlockingIOError if the buffer is full."""
        raise NotImplementedError


class TcpLink(StreamLink):
    """A TCP connection to a listening autopilot."""

    def __init__(self, sock: socket.socket) -> None:
        super().__init__()
        sock.setblocking(False)
        with suppress(OSError):  # queue here, where a setpoint can be replaced
            sock.setsockopt(socket.IPPROTO_TCP, TCP_NOTSENT_LOWAT, 1)
        self._socket = sock
        self._open = True

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

    def _write(self, data: bytes) -> int:
        return self._socket.send(data)

    def close(self) -> None:
        self._socket.close()


class SerialLink(StreamLink):
    """A serial port through pyserial."""

    def __init__(self, device: str, baud: int) -> None:
        import serial

        super().__init__()
        try:
            self._port = serial.Serial(device, baud, timeout=0)
        except (serial.SerialException, ValueError, OverflowError) as error:
            raise LinkError(
                f"serial port {device} at {baud} baud cannot be opened: {error}"
            ) from None

    def receive(self, timeout_s: float) -> list[Chunk]:
        self._flush()
        try:
            self._port.timeout = max(0.0, timeout_s)
            first = self._port.read(1)
            data = first + self._port.read(self._port.in_waiting) if first else b""
        except OSError:  # unplugged: pyserial raises different subclasses
            select.select([], [], [], max(0.0, timeout_s))
            return []
        return [(data, "serial")] if data else []

    def _write(self, data: bytes) -> int:
        # pyserial's write waits in a busy loop while the port's buffer is full
        return os.write(self._port.fileno(), data)

    def close(self) -> None:
        self._port.close()


def open_lockstep_link() -> LockstepLink:
    """Open a link on a free port of this computer, for a simulator in lockstep."""
    sock = _udp_socket()
    sock.bind(("127.0.0.1", 0))
    return LockstepLink(sock, None)


def _udp_socket() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    sock.setblocking(False)
    return sock


def open_link(address: str) -> Link:
    """Open the link at `address`, for example "udpin:127.0.0.1:14540" (see the module).

    Raises LinkError, which says what to change.
    """
    kind, _, rest = address.partition(":")
    host, _, tail = rest.rpartition(":")
    if kind not in ("udpin", "udpout", "tcp", "serial") or not host or not _is_number(tail):
        raise LinkError(
            f"connection {shown(address)} is not understood; use udpin:HOST:PORT, "
            "udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"
        )
    number = int(tail)
    if kind == "serial":
        return SerialLink(host, number)
    if not 0 <= number <= 65535:
        raise LinkError(f"connection {address!r}: port {number} is not within 0 .. 65535")
    return _open_socket(kind, host, number, address)


def _is_number(text: str) -> bool:
    """Whether it is a number of at most ten of the digits 0 .. 9: a port or a baud rate."""
    return text.isascii() and text.isdigit() and len(text) <= 10


def _open_socket(kind: str, host: str, port: int, address: str) -> Link:
    try:
        if kind == "tcp":
            connection = socket.create_connection((host, port), timeout=5.0)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return TcpLink(connection)
        peer = (socket.gethostbyname(host), port)
        sock = _udp_socket()
        if kind == "udpout":
            return UdpLink(sock, peer)
        sock.bind(peer)
    except (OSError, UnicodeError) as error:  # UnicodeError: a host like a..b
        raise LinkError(
            f"connection {abridged(address)} cannot be opened: "
            f"{getattr(error, 'strerror', None) or error}"
            + ("; another program uses the port" if getattr(error, "errno", 0) == 98 else "")
        ) from None
    return UdpLink(sock, None)
