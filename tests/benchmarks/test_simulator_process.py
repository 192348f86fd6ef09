"""The simulator as a process: run with `--benchmark-enable`. Nothing here asserts on time.

1000 / (milliseconds per second of flight) is the ratio to real time. The companion only answers
TIMESYNC, from frames packed beforehand, so that what it costs is the simulator's time.
"""

from __future__ import annotations

import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from fastcrc.crc16 import mcrf4xx

TIMESYNC, TIMESYNC_EXTRA, TIMESYNC_LENGTH = 111, 34, 16
COMMAND_LONG, COMMAND_LONG_EXTRA = 76, 152
ARM, TAKE_OFF = 400, 22
HEARTBEAT = b"\x00\x00\x00"  # its message id


def frame(number: int, extra: int, payload: bytes) -> bytes:
    """MAVLink 2, from system 255."""
    body = bytes((len(payload), 0, 0, 0, 255, 190)) + number.to_bytes(3, "little") + payload
    return b"\xfd" + body + mcrf4xx(body + bytes((extra,))).to_bytes(2, "little")


class Companion:
    """A socket, the vehicle that flies towards it, and how far that has come."""

    def __init__(self, *options: str) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(60.0)
        port = self.socket.getsockname()[1]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "simulator", "--connect", f"udpout:127.0.0.1:{port}", *options],
            stdout=subprocess.PIPE,
            text=True,
        )
        self.vehicle = ("", 0)
        self.time_ns = 0

    def hear(self) -> bytes:
        datagram, self.vehicle = self.socket.recvfrom(65535)
        return datagram

    def fly(self, duration_s: float) -> None:
        """Answer so much flight's barriers: the last frame of a datagram asks."""
        end_ns = self.time_ns + round(duration_s * 1e9)
        while self.time_ns < end_ns:
            datagram = self.hear()
            asked = datagram.rfind(b"\x6f\x00\x00", max(0, len(datagram) - 25))
            if asked < 0:
                continue
            stamp = datagram[asked + 11 : -2].ljust(8, b"\0")
            self.time_ns = int.from_bytes(stamp, "little")
            answer = b"\x01".ljust(8, b"\0") + stamp
            self.socket.sendto(frame(TIMESYNC, TIMESYNC_EXTRA, answer), self.vehicle)

    def command(self, number: int, first: float) -> None:
        import struct

        payload = struct.pack("<7fHBBB", first, *(float("nan"),) * 6, number, 1, 1, 0)
        self.socket.sendto(frame(COMMAND_LONG, COMMAND_LONG_EXTRA, payload), self.vehicle)

    def close(self) -> str:
        self.process.terminate()
        output, _ = self.process.communicate()
        self.socket.close()
        return output


@contextmanager
def companion(*options: str) -> Iterator[Companion]:
    opened = Companion(*options)
    try:
        yield opened
    finally:
        opened.close()


@pytest.mark.benchmark(group="a second in lockstep over UDP")
@pytest.mark.parametrize("links", [(), ("--gcs", "none")], ids=["both links", "companion only"])
@pytest.mark.parametrize("flying", [False, True], ids=["on the ground", "holding position"])
def test_a_second_in_lockstep(benchmark: Any, flying: bool, links: tuple[str, ...]) -> None:
    with companion("--lockstep", *links) as peer:
        peer.fly(6.0)
        if flying:
            peer.command(TAKE_OFF, float("nan"))
            peer.command(ARM, 1.0)
            peer.fly(12.0)
        benchmark(peer.fly, 1.0)


@pytest.mark.benchmark(group="from the command to the first heartbeat")
def test_boot(benchmark: Any) -> None:
    def boot() -> None:
        with companion() as peer:
            while peer.hear()[7:10] != HEARTBEAT:
                pass

    benchmark(boot)
