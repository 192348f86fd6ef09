"""The `simulator` process, and a client of it over UDP: pymavlink and a socket."""

from __future__ import annotations

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
    """Run `python -m simulator` with its output in pipes; it is killed at the end of the block."""
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
    """A UDP socket that stores the newest message of each kind."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self.port = self._socket.getsockname()[1]
        self.codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
        self.vehicle: tuple[str, int] | None = None
        self.newest: dict[str, Any] = {}
        self._parser = mavlink.MAVLink(None)

    def __enter__(self) -> Peer:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def send(self, message: Any) -> None:
        assert self.vehicle is not None
        self._socket.sendto(message.pack(self.codec), self.vehicle)

    def listen(self, until: Callable[[], bool], *, each: Callable[[], None] = lambda: None) -> None:
        """Receive until `until` holds; `each` is called at every HEARTBEAT of the vehicle."""
        deadline_s = time.monotonic() + 120.0
        while not until():
            self._socket.settimeout(max(deadline_s - time.monotonic(), 0.01))
            datagram, self.vehicle = self._socket.recvfrom(65535)
            for message in self._parser.parse_buffer(datagram) or []:
                self.newest[message.get_type()] = message
                if message.get_type() == "HEARTBEAT":
                    each()

    def heartbeat(self) -> None:
        self.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))

    def command(self, number: int, *params: float) -> None:
        filled = (*params, *(0.0,) * (7 - len(params)))
        self.send(mavlink.MAVLink_command_long_message(1, 1, number, 0, *filled))
