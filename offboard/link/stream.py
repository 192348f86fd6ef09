"""TCP and serial links: byte streams on a file descriptor. After a break `RedialingLink` opens the
same address again, and `ListeningLink` accepts the next client."""

from __future__ import annotations

import errno
import math
import os
import select
import socket
import sys
import threading
from collections.abc import Callable, Hashable
from contextlib import suppress
from dataclasses import dataclass

from offboard.documents.errors import Unavailable
from offboard.link import clock
from offboard.link.interface import Chunk, Link
from offboard.mavlink.framing import SETPOINTS
from offboard.mavlink.senders import PEER_SILENT_S

READ_BYTES = 65536
BATCH_BYTES = 1 << 20  # that one call of `receive` reads, about
QUEUED_MAX = 50  # frames
BROKEN, RENEWED = "the connection broke: connecting again", "connected again"
CONNECT_S = 5.0
RETRY_S = 0.5
UNSENT_MAX_S = 5.0  # the connection is closed if sent bytes are not acknowledged for this time
TCP_NOTSENT_LOWAT = 25  # option of Linux; the socket module has it since Python 3.12


@dataclass(frozen=True, slots=True)
class Stream:
    """An open connection or port in non-blocking mode."""

    descriptor: int
    close: Callable[[], None]
    host: str = ""  # of the other end


def connect(host: str, port: int) -> Stream:
    """Connect to a listening autopilot. Raises OSError."""
    return tcp_stream(socket.create_connection((host, port), timeout=CONNECT_S), host)


def tcp_stream(connection: socket.socket, host: str) -> Stream:
    """A connected socket as a stream."""
    connection.setblocking(False)
    with suppress(OSError):
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # queue frames in this process instead of the kernel, so that a setpoint can be replaced
        connection.setsockopt(socket.IPPROTO_TCP, TCP_NOTSENT_LOWAT, 1)
        if sys.platform == "linux":
            unsent_ms = round(1000 * UNSENT_MAX_S)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, unsent_ms)
    return Stream(connection.fileno(), connection.close, host)


def open_port(device: str, baud: int) -> Stream:
    """Open a serial port with pyserial, exclusively for this process and its supervisor, because
    two readers would each get a part of the bytes. Raises Unavailable."""
    import serial

    try:
        port = serial.Serial(device, baud, timeout=0, exclusive=True)
    except (serial.SerialException, ValueError, OverflowError) as error:
        number = getattr(error, "errno", None)  # pyserial's own text repeats number and device
        reason = os.strerror(number) if number else error
        reason = "another program has it open" if number == errno.EAGAIN else reason
        raise Unavailable(
            f"serial port {device} at {baud} baud cannot be opened: {reason}"
        ) from None
    return Stream(port.fileno(), port.close)


class StreamLink(Link):
    """A link on `stream`. Frames are queued while the buffer of the kernel is full; a new setpoint
    replaces a queued one, and the oldest frames are dropped if there are too many. If the stream
    breaks, the queue is dropped; this class does not open a new stream, its subclasses do."""

    is_stream = True

    def __init__(
        self, stream: Stream | None, name: str, capacity_bytes_ps: float | None = None
    ) -> None:
        super().__init__()
        self.capacity_bytes_ps = capacity_bytes_ps
        self._stream = stream
        self._name = name
        self._empty_s = self._heard_s = clock.monotonic_s()  # bytes that wait arrived after this
        self._begun = b""
        self._queued: list[bytes] = []

    # --- the stream ---

    def _seek(self) -> None:
        """Start to look for a new stream. Does not wait."""

    def _offered(self, silent_s: float) -> Stream | None:
        """Return a new stream if there is one. `silent_s` is the time since the present stream was
        heard; infinite without a stream."""
        return None

    def _renew(self) -> None:
        """Take a new stream, if there is one."""
        silent_s = clock.monotonic_s() - self._heard_s if self._stream else math.inf
        stream = self._offered(silent_s)
        if stream is None:
            return
        if self._stream:
            self._drop()
        if self.opened:  # this is not the first stream
            self.report.tell(RENEWED)
        self._stream = stream
        self._empty_s = self._heard_s = clock.monotonic_s()
        self.opened += 1

    def _drop(self) -> None:
        """Close the stream and drop the queue."""
        assert self._stream is not None
        with suppress(OSError):
            self._stream.close()
        self._stream, self._begun, self._queued = None, b"", []
        self.opened += 1

    def _break(self) -> None:
        self._drop()
        self.report.tell(BROKEN)
        self._seek()

    # --- in ---

    def wait(self, timeout_s: float) -> None:
        if self._stream is None:
            select.select(self.descriptors(), [], [], max(0.0, timeout_s))
        elif not self._readable(0.0):
            self._readable(timeout_s)

    def receive(self) -> list[Chunk]:
        self._renew()
        self._flush()
        self._readable(0.0)  # updates `_empty_s` if nothing has arrived
        arrived_s, data = self._empty_s, b""
        with suppress(BlockingIOError):
            while len(data) < BATCH_BYTES and self._readable(0.0) and (more := self._read()):
                data += more
        if data:
            self._heard_s = clock.monotonic_s()
        return [Chunk(data, self._name, arrived_s)] if data else []

    def _readable(self, timeout_s: float) -> bool:
        if self._stream is None:
            return False
        began_s = clock.monotonic_s()
        awaited = [self._stream.descriptor]
        readable = bool(select.select(awaited, [], [], max(0.0, timeout_s))[0])
        ended_s = clock.monotonic_s()
        if not readable:
            self._empty_s = began_s
        elif 0.0 < timeout_s >= ended_s - began_s:  # select waited, and this process did not pause
            self._empty_s = ended_s
        return readable

    def _read(self) -> bytes:
        """Read waiting bytes. Returns none, and drops the stream, if the other end has closed it or
        the device is unplugged."""
        assert self._stream is not None
        try:
            data = os.read(self._stream.descriptor, READ_BYTES)
        except BlockingIOError:
            raise
        except OSError:
            data = b""
        if not data:
            self._break()
        return data

    # --- out ---

    def send(self, data: bytes, peer: Hashable | None) -> None:
        if self._stream is None:
            return  # the flight notices a broken link as silence
        if _is_setpoint(data):
            self._queued = [other for other in self._queued if not _is_setpoint(other)]
        self._queued = [*self._queued, data][-QUEUED_MAX:]
        self._flush()

    def _flush(self) -> None:
        """Write as much of the queue as the kernel's buffer takes."""
        try:
            while self._stream and (self._begun or self._queued):
                if not self._begun:
                    self._begun = self._queued.pop(0)
                # not pyserial's write, which busy-waits while the buffer is full
                self._begun = self._begun[os.write(self._stream.descriptor, self._begun) :]
        except BlockingIOError:
            return
        except OSError:
            self._break()

    # --- the descriptors ---

    def descriptors(self) -> tuple[int, ...]:
        return (self._stream.descriptor,) if self._stream else ()

    def close(self) -> None:
        if self._stream:
            self._drop()


class RedialingLink(StreamLink):
    """A link whose stream `open_stream` opens. After a break a thread calls `open_stream` until it
    succeeds. `open_stream` may wait, and raise OSError or Unavailable."""

    def __init__(
        self, open_stream: Callable[[], Stream], name: str, capacity_bytes_ps: float | None = None
    ) -> None:
        super().__init__(open_stream(), name, capacity_bytes_ps)
        self._open_stream = open_stream
        self._found: list[Stream] = []  # at most one
        self._closing = threading.Event()

    def _seek(self) -> None:
        # no check for a running thread: the previous one has found its stream and is about to end
        threading.Thread(target=self._dial, daemon=True).start()

    def _dial(self) -> None:
        while not self._closing.wait(RETRY_S):
            with suppress(OSError, Unavailable):
                self._found.append(self._open_stream())
                if self._closing.is_set():
                    self._discard()
                return

    def _offered(self, silent_s: float) -> Stream | None:
        return self._found.pop() if self._found else None

    def close(self) -> None:
        super().close()
        self._closing.set()
        self._discard()

    def _discard(self) -> None:
        with suppress(IndexError):
            self._found.pop().close()


class ListeningLink(StreamLink):
    """Accepts one client at a time on `listening`, as the README says."""

    listens = True

    def __init__(self, listening: socket.socket, name: str, stream: Stream | None = None) -> None:
        super().__init__(stream, name)
        listening.setblocking(False)
        self._listening = listening
        self._host = ""  # host of the vehicle, once it was found

    def _offered(self, silent_s: float) -> Stream | None:
        try:
            client, address = self._listening.accept()
        except OSError:  # no client waits
            return None
        host = address[0]
        if silent_s <= PEER_SILENT_S or self._host not in ("", host):
            client.close()
            self.report.count(address, 1, "connection")
            return None
        return tcp_stream(client, host)

    def follow(self, peer: Hashable) -> None:
        self._host = self._stream.host if self._stream else self._host

    def descriptors(self) -> tuple[int, ...]:
        return (self._listening.fileno(), *super().descriptors())

    def close(self) -> None:
        super().close()
        self._listening.close()


def _is_setpoint(frame: bytes) -> bool:
    """Whether a MAVLink 2 frame is a setpoint."""
    return int.from_bytes(frame[7:10], "little") in SETPOINTS
