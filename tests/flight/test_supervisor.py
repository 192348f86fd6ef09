"""The supervisor on a real link to a vehicle that only listens: when it acts, and when not.

Flights that it saves are in tests/process/test_controller_lost.py.
"""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from offboard.analysis import tlog
from offboard.flight.connection import open_link
from offboard.flight.log import FlightLog
from offboard.flight.supervisor import Guard, Supervisor
from offboard.mavlink.events import VehicleFound

LONG_S = 20.0
VEHICLE = VehicleFound(7, 1, "px4")
OURS, ON_GROUND, NOT_OURS = (
    Guard(VEHICLE, ours=True, flying=True),
    Guard(VEHICLE, ours=True, flying=False),
    Guard(VEHICLE, ours=False, flying=True),
)


class Rig:
    """A supervisor with the link to a vehicle, which is a socket, and with a log."""

    def __init__(self, directory: Path, kind: str) -> None:
        self.vehicle = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.vehicle.bind(("127.0.0.1", 0))
        self.vehicle.settimeout(LONG_S)
        self.sender: Any = None  # of the newest command
        peer = self.vehicle.getsockname()
        port = 0 if kind == "udpin" else peer[1]
        self.link = open_link(f"{kind}:127.0.0.1:{port}")
        self.link.follow(peer)
        self.peer = peer
        self.log = FlightLog(directory / "x", "", real_time=True)
        self.supervisor = Supervisor()

    def beat(self, guard: Guard) -> None:
        self.supervisor.beat(guard, self.peer, self.link, self.log.descriptor)

    def abandon(self) -> None:
        """End as a process that is killed: the kernel closes its descriptors."""
        self.supervisor._channel.close()
        self.link.close()

    def await_end(self) -> None:
        self.supervisor._process.wait(LONG_S)

    def heard(self) -> list[Any]:
        """What the vehicle has received until the supervisor ended."""
        messages = []
        codec = mavlink.MAVLink(None)
        self.vehicle.settimeout(0.0)
        while True:
            try:
                messages += codec.parse_buffer(self.vehicle.recv(65536)) or []
            except BlockingIOError:
                return messages

    def next_command(self) -> Any:
        """The next COMMAND_LONG that the vehicle receives."""
        codec = mavlink.MAVLink(None)
        while True:
            data, self.sender = self.vehicle.recvfrom(65536)
            for message in codec.parse_buffer(data) or []:
                if message.get_type() == "COMMAND_LONG":
                    return message

    def disarm(self) -> None:
        """The vehicle reports that it is down, which ends the supervisor."""
        codec = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
        message = mavlink.MAVLink_heartbeat_message(2, 12, 1, 0x06040000, 3, 3)
        self.vehicle.sendto(message.pack(codec), self.sender)


@pytest.fixture(params=["udpin", "udpout"])
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path, request.param)
    with rig.log, rig.supervisor:
        rig.supervisor.await_ready()
        yield rig
    rig.link.close()
    rig.vehicle.close()


def test_it_takes_over_when_the_controller_ends(rig: Rig) -> None:
    rig.beat(ON_GROUND)
    rig.beat(OURS)
    rig.abandon()
    command = rig.next_command()
    assert (command.command, command.param2, command.param3) == (176, 4.0, 3.0)  # AUTO.LOITER
    assert (command.target_system, command.get_srcSystem()) == (7, 7)
    rig.disarm()
    rig.await_end()
    texts = [entry.message.text for entry in tlog.read(rig.log.path).messages
             if entry.name == "STATUSTEXT"]  # fmt: skip
    said = "".join(texts)
    assert said.startswith("supervisor: taking over: the controller ended in flight")
    assert said.endswith("supervisor: the vehicle is disarmed")


def test_it_takes_over_when_the_beats_stop_and_says_so_first(rig: Rig) -> None:
    rig.beat(OURS)
    assert not rig.supervisor.has_taken_over()
    assert rig.next_command().command == 176
    assert rig.supervisor.has_taken_over()
    assert rig.supervisor.said[0] == "taking over: the controller has not answered for 0.9 s"
    rig.disarm()
    while not rig.supervisor.await_end(0.05):
        pass
    assert rig.supervisor.said[-1] == "the vehicle is disarmed"
    assert not rig.supervisor.lost


@pytest.mark.parametrize("guard", [ON_GROUND, NOT_OURS])
def test_a_vehicle_that_is_not_ours_or_on_the_ground_is_left_alone(guard: Guard, rig: Rig) -> None:
    rig.beat(OURS)
    rig.beat(guard)
    rig.abandon()
    rig.await_end()
    assert rig.heard() == []


def test_signals_do_not_end_it(rig: Rig) -> None:
    """A service manager signals all processes of a service."""
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        os.kill(rig.supervisor.pid, number)
    rig.beat(OURS)
    assert rig.next_command().command == 176
    rig.disarm()


def test_a_supervisor_that_ends_is_noticed(rig: Rig) -> None:
    rig.beat(OURS)
    assert not rig.supervisor.lost
    os.kill(rig.supervisor.pid, signal.SIGKILL)
    rig.await_end()
    rig.beat(OURS)
    rig.beat(OURS)
    assert rig.supervisor.lost
    assert not rig.supervisor.has_taken_over()
