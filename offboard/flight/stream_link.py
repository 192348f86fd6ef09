"""TCP and serial links: streams of bytes through a file descriptor."""

from __future__ import annotations

import os
import select
import socket
from collections.abc import Callable, Hashable
from contextlib import suppress

from offboard.flight import clock
from offboard.flight.link import Chunk, LinkError, Strangers

READ_BYTES = 65536
BATCH_BYTES = 1 << 20  # of one call
QUEUED_MAX = 50  # frames
BITS_OF_A_BYTE = 10  # on a serial line: start, eight bits, stop
SETPOINTS = frozenset({82, 84, 86})  # SET_ATTITUDE_TARGET, SET_POSITION_TARGET_*
TCP_NOTSENT_LOWAT = 25  # Linux's option, which the socket module names since Python 3.12


class StreamLink:
    """A stream through `descriptor`, which does not block. Frames are queued while its buffer is
    full: a new setpoint replaces a queued one, and of too many frames the oldest are dropped."""

    is_stream = True

    def __init__(
        self,
        descriptor: int,
        name: str,
        close: Callable[[], None],
        capacity_bytes_ps: float | None = None,
    ) -> None:
        self.strangers = Strangers()
        self.capacity_bytes_ps = capacity_bytes_ps
        self._descriptor = descriptor
        self._name = name
        self._close = close
        self._open = True
        self._empty_s = clock.monotonic_s()  # all that is waiting arrived later
        self._begun = b""
        self._queued: list[bytes] = []

    # --- in ---

    def receive(self, timeout_s: float) -> list[Chunk]:
        self._flush()
        if not self._open:
            select.select([], [], [], max(0.0, timeout_s))
            return []
        if not self._readable(0.0) and not self._readable(timeout_s):
            return []
        arrived_s, data = self._empty_s, b""
        with suppress(BlockingIOError):
            while len(data) < BATCH_BYTES and self._readable(0.0) and (more := self._read()):
                data += more
        return [Chunk(data, self._name, arrived_s)] if data else []

    def _readable(self, timeout_s: float) -> bool:
        began_s = clock.monotonic_s()
        readable = bool(select.select([self._descriptor], [], [], max(0.0, timeout_s))[0])
        if not readable:
            self._empty_s = began_s
        return readable

    def _read(self) -> bytes:
        """Bytes that are waiting. None although it is readable: closed or unplugged."""
        try:
            data = os.read(self._descriptor, READ_BYTES)
        except BlockingIOError:
            raise
        except OSError:
            data = b""
        self._open = bool(data)
        return data

    # --- out ---

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
                # not pyserial's write, which waits in a busy loop while the buffer is full
                self._begun = self._begun[os.write(self._descriptor, self._begun) :]

    # --- the vehicle ---

    def follow(self, peer: Hashable) -> None:
        """A stream has one other end."""

    def descriptors(self) -> tuple[int, ...]:
        return (self._descriptor,)

    def close(self) -> None:
        self._close()


def _is_setpoint(frame: bytes) -> bool:
    """Whether a MAVLink 2 frame is a setpoint."""
    return int.from_bytes(frame[7:10], "little") in SETPOINTS


def tcp_link(host: str, port: int) -> StreamLink:
    """A connection to a listening autopilot. Raises OSError."""
    connection = socket.create_connection((host, port), timeout=5.0)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setblocking(False)
    with suppress(OSError):  # queue here, where a setpoint can be replaced
        connection.setsockopt(socket.IPPROTO_TCP, TCP_NOTSENT_LOWAT, 1)
    return StreamLink(connection.fileno(), "tcp", connection.close)


def serial_link(device: str, baud: int) -> StreamLink:
    """A serial port, opened by pyserial. Raises LinkError."""
    import serial

    try:
        port = serial.Serial(device, baud, timeout=0)
    except (serial.SerialException, ValueError, OverflowError) as error:
        raise LinkError(f"serial port {device} at {baud} baud cannot be opened: {error}") from None
    return StreamLink(port.fileno(), "serial", port.close, baud / BITS_OF_A_BYTE)
