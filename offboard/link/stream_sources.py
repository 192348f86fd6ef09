"""Where the streams of a link come from: a listening autopilot, a serial port, or our clients."""

from __future__ import annotations

import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress

from offboard.link.interface import LinkError, LinkUnavailable
from offboard.link.stream import Source, Stream
from offboard.mavlink.senders import PEER_SILENT_S

CONNECT_S = 5.0
RETRY_S = 0.5
UNSENT_MAX_S = 5.0  # that nobody acknowledges: the other end is gone
TCP_NOTSENT_LOWAT = 25  # Linux's option, which the socket module names since Python 3.12


class Redial(Source):
    """Calls `open_stream` in a thread until it succeeds. It may wait, and raise OSError or
    LinkError."""

    def __init__(self, open_stream: Callable[[], Stream]) -> None:
        super().__init__()
        self._open_stream = open_stream
        self._found: list[Stream] = []  # at most one
        self._closing = threading.Event()

    def seek(self) -> None:
        # always: the thread before has found its stream, although it may not have ended yet
        threading.Thread(target=self._dial, daemon=True).start()

    def _dial(self) -> None:
        while not self._closing.wait(RETRY_S):
            with suppress(OSError, LinkError):
                stream = self._open_stream()
                self._found.append(stream)
                if self._closing.is_set():
                    self._discard()
                return

    def offer(self, silent_s: float) -> Stream | None:
        return self._found.pop() if self._found else None

    def wait(self, timeout_s: float) -> None:
        self._closing.wait(max(0.0, timeout_s))

    def close(self) -> None:
        self._closing.set()
        self._discard()

    def _discard(self) -> None:
        with suppress(IndexError):
            self._found.pop().close()


class Listener(Source):
    """Accepts one client on `sock`. Another one takes its place when it has been silent; once the
    vehicle was found, only from the vehicle's host."""

    def __init__(self, sock: socket.socket) -> None:
        super().__init__()
        sock.setblocking(False)
        self._socket = sock
        self._host = ""  # of the vehicle, once it was found

    def offer(self, silent_s: float) -> Stream | None:
        try:
            client, address = self._socket.accept()
        except OSError:  # nobody
            return None
        host, port = address[:2]
        if silent_s <= PEER_SILENT_S or self._host not in ("", host):
            client.close()
            self.report.count(f"{host}:{port}", 1, "connection")
            return None
        return tcp_stream(client, host)

    def keep_to(self, host: str) -> None:
        self._host = host

    def descriptors(self) -> tuple[int, ...]:
        return (self._socket.fileno(),)

    def close(self) -> None:
        self._socket.close()


def connect(host: str, port: int) -> Stream:
    """Connect to a listening autopilot. Raises OSError."""
    return tcp_stream(socket.create_connection((host, port), timeout=CONNECT_S), host)


def tcp_stream(connection: socket.socket, host: str) -> Stream:
    """A connected socket as a stream."""
    connection.setblocking(False)
    with suppress(OSError):
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # queue here, where a setpoint can be replaced
        connection.setsockopt(socket.IPPROTO_TCP, TCP_NOTSENT_LOWAT, 1)
        if sys.platform == "linux":
            unsent_ms = round(1000 * UNSENT_MAX_S)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, unsent_ms)
    return Stream(connection.fileno(), connection.close, host)


def open_port(device: str, baud: int) -> Stream:
    """Open a serial port with pyserial, for this process and its supervisor alone: of two readers
    each would get a part of the bytes. Raises LinkUnavailable."""
    import serial

    try:
        port = serial.Serial(device, baud, timeout=0, exclusive=True)
    except (serial.SerialException, ValueError, OverflowError) as error:
        raise LinkUnavailable(
            f"serial port {device} at {baud} baud cannot be opened: {error}"
        ) from None
    return Stream(port.fileno(), port.close)
