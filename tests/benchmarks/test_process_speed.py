"""The simulator as a process: run with `--benchmark-enable -s`. Nothing here asserts on time.

1000 / (milliseconds per second of flight) is the ratio to real time. The companion only answers
TIMESYNC, without a codec, so that what is measured is the simulator.
"""

from __future__ import annotations

import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import common as mavlink

pytestmark = pytest.mark.slow
TIMESYNC, TIMESYNC_EXTRA = 111, 34
COMMAND_LONG, COMMAND_LONG_EXTRA = 76, 152
ARM, TAKE_OFF = 400, 22


def frame(number: int, extra: int, payload: bytes) -> bytes:
    """MAVLink 2, from system 255."""
    body = bytes((len(payload), 0, 0, 0, 255, 190)) + number.to_bytes(3, "little") + payload
    return b"\xfd" + body + mcrf4xx(body + bytes((extra,))).to_bytes(2, "little")


class Flight:
    """A socket, the vehicle that sends to it, and how far that has come."""

    def __init__(self, *options: str) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(60.0)
        port = self.socket.getsockname()[1]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "simulator", "--connect", f"udpout:127.0.0.1:{port}", *options],
            stdout=subprocess.DEVNULL,
        )
        self.vehicle = ("", 0)
        self.time_ns = 0

    def hear(self) -> bytes:
        datagram, self.vehicle = self.socket.recvfrom(65535)
        return datagram

    def fly(self, duration_s: float) -> bytes:
        """Answer the barriers of so much flight, each the last frame of its datagram; that."""
        end_ns = self.time_ns + round(duration_s * 1e9)
        datagram = b""
        while self.time_ns < end_ns:
            datagram = self.hear()
            asked = datagram.rfind(b"\x6f\x00\x00", max(0, len(datagram) - 25))
            if asked >= 0:
                stamp = datagram[asked + 11 : -2].ljust(8, b"\0")
                self.time_ns = int.from_bytes(stamp, "little")
                answer = b"\x01".ljust(8, b"\0") + stamp
                self.socket.sendto(frame(TIMESYNC, TIMESYNC_EXTRA, answer), self.vehicle)
        return datagram

    def command(self, number: int, first: float) -> None:
        payload = struct.pack("<7fHBBB", first, *(float("nan"),) * 6, number, 1, 1, 0)
        self.socket.sendto(frame(COMMAND_LONG, COMMAND_LONG_EXTRA, payload), self.vehicle)


@contextmanager
def companion(*options: str) -> Iterator[Flight]:
    peer = Flight(*options)
    try:
        yield peer
    finally:
        peer.process.terminate()
        peer.process.wait()
        peer.socket.close()


def heard(datagram: bytes, name: str) -> list[Any]:
    messages = mavlink.MAVLink(None).parse_buffer(datagram) or []
    return [message for message in messages if message.get_type() == name]


@pytest.mark.benchmark(group="a second in lockstep over UDP")
@pytest.mark.parametrize("links", [(), ("--gcs", "none")], ids=["both links", "companion only"])
@pytest.mark.parametrize("flying", [False, True], ids=["on the ground", "holding position"])
def test_a_second_in_lockstep(benchmark: Any, flying: bool, links: tuple[str, ...]) -> None:
    with companion("--lockstep", *links) as peer:
        datagram = peer.fly(6.0)
        if flying:
            peer.command(TAKE_OFF, float("nan"))
            peer.command(ARM, 1.0)
            datagram = peer.fly(12.0)
        (position,) = heard(datagram, "LOCAL_POSITION_NED")
        assert (position.z < -2.0) == flying
        benchmark(peer.fly, 1.0)


@pytest.mark.benchmark(group="from the command to the first heartbeat")
def test_boot(benchmark: Any) -> None:
    def boot() -> None:
        with companion() as peer:
            while not heard(peer.hear(), "HEARTBEAT"):
                pass

    benchmark(boot)


@pytest.mark.benchmark(group="twenty vehicles in real time")
def test_instances(benchmark: Any) -> None:
    """The last line says how many steps ended later than the next one was due."""
    options = ("--instances", "20", "--connect", "udpout:127.0.0.1:24540", "--gcs", "none")

    def run() -> str:
        command = [sys.executable, "-m", "simulator", *options, "--duration", "5"]
        output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        return output.splitlines()[-1]

    output = benchmark.pedantic(run, rounds=1)
    print(f"\n{output}")
    assert "of 1250 deadlines missed" in output
