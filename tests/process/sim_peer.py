"""A companion or ground station over UDP for tests of processes: pymavlink and a socket."""

from __future__ import annotations

import math
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from pymavlink.dialects.v20 import all as mavlink


@contextmanager
def simulator(*options: str) -> Iterator[subprocess.Popen[str]]:
    """`python -m simulator` with its output, gone at the end of the block."""
    process = subprocess.Popen(
        [sys.executable, "-m", "simulator", *options],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


class Peer:
    """A bound UDP socket that answers TIMESYNC and remembers what it heard."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        self.port = self._socket.getsockname()[1]
        self.codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
        self.vehicle: tuple[str, int] | None = None
        self.time_s = 0.0  # vehicle time of the newest position
        self.received: list[tuple[float, Any]] = []
        self.newest: dict[str, Any] = {}
        self.answers_timesync = True
        self._heartbeat_s = math.inf  # when the next is due
        self._parser = mavlink.MAVLink(None)

    def __enter__(self) -> Peer:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def send(self, message: Any) -> None:
        assert self.vehicle is not None
        self._socket.sendto(message.pack(self.codec), self.vehicle)

    def listen(
        self,
        until: Callable[[], bool],
        *,
        each: Callable[[], None] | None = None,
        period_s: float = 0.05,
        wall_s: float = 120.0,
    ) -> None:
        """Receive until `until`; `each` is called every `period_s` of vehicle time."""
        deadline_s = time.monotonic() + wall_s
        next_s = self.time_s
        while not until():
            remaining_s = deadline_s - time.monotonic()
            assert remaining_s > 0, f"not reached within {wall_s} s of wall time"
            self._socket.settimeout(remaining_s)
            datagram, self.vehicle = self._socket.recvfrom(65535)
            for message in self._parser.parse_buffer(datagram) or []:
                if message.get_type() == "LOCAL_POSITION_NED":
                    self.time_s = message.time_boot_ms / 1000.0
                    if self.time_s >= self._heartbeat_s:
                        self.heartbeat()
                    if each is not None and self.time_s >= next_s:
                        each()
                        next_s += period_s
                self.received.append((self.time_s, message))
                self.newest[message.get_type()] = message
                if message.get_type() == "TIMESYNC" and message.tc1 == 0 and self.answers_timesync:
                    self.send(mavlink.MAVLink_timesync_message(1, message.ts1))

    def of(self, kind: str) -> list[Any]:
        return [message for _, message in self.received if message.get_type() == kind]

    @property
    def texts(self) -> list[str]:
        return [message.text.rstrip("\t") for message in self.of("STATUSTEXT")]

    def heartbeat(self) -> None:
        """One now and, from now on, one every second of vehicle time while it listens."""
        self._heartbeat_s = self.time_s + 1.0
        self.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))

    def command(self, number: int, *params: float) -> None:
        filled = (*params, *(0.0,) * (7 - len(params)))
        self.send(mavlink.MAVLink_command_long_message(1, 1, number, 0, *filled))
