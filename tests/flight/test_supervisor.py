"""The supervisor on a real link to a vehicle that only listens: when it acts, and when not.

test_recovery.py tests what it asks for, tests/process/test_ended_flights.py a flight that it lands,
and test_edges.py how the loop uses it.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from processes import RECORDING, eventually, free_port
from pymavlink.dialects.v20 import common as mavlink

from offboard.analysis import tlog
from offboard.documents.errors import Unavailable
from offboard.link import clock
from offboard.link.connection import open_link
from offboard.link.log import FlightLog
from offboard.link.udp import BATCH_MAX
from offboard.mavlink.dialects.base import SetpointLoss
from offboard.mavlink.events import VehicleFound
from offboard.mavlink.outgoing import Heartbeat
from offboard.mavlink.session import Session, SessionSettings
from offboard.mavlink.signing import Signing
from offboard.supervisor.recovery import Supervised
from offboard.supervisor.supervisor import Supervisor

TIMEOUT_S = 20.0
OFFBOARD, POSCTL, LOITER, LANDING = (
    0x00060000,
    0x00030000,
    0x03040000,
    0x06040000,
)  # custom_mode of PX4
KEY, SIGNED_FROM = bytes(range(32)), 10**12
VEHICLE = VehicleFound(7, 1, "px4")
OURS, ON_GROUND, NOT_OURS = (
    Supervised(VEHICLE, ours=True, flying=True),
    Supervised(VEHICLE, ours=True, flying=False),
    Supervised(VEHICLE, ours=False, flying=True),
)


class Rig:
    """A supervisor with a log and the link to a vehicle, which is a socket."""

    def __init__(self, directory: Path, kind: str) -> None:
        self.codec = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
        self.signing = None
        if kind == "signed":
            kind, self.signing = "tcpin", Signing(KEY, SIGNED_FROM, clock.monotonic_s)
            self.codec.signing.secret_key, self.codec.signing.sign_outgoing = KEY, True
            self.codec.signing.timestamp = SIGNED_FROM
        stream = kind == "tcpin"
        self.vehicle = socket.socket(
            socket.AF_INET, socket.SOCK_STREAM if stream else socket.SOCK_DGRAM
        )
        self.vehicle.settimeout(TIMEOUT_S)
        self.vehicle.bind(("127.0.0.1", 0))
        self.peer: Any = "tcp" if stream else self.vehicle.getsockname()
        port = self.peer[1] if kind == "udpout" else free_port()
        self.link: Any = open_link(f"{kind}:127.0.0.1:{port}")
        self.link.follow(self.peer)
        with socket.socket(fileno=os.dup(self.link.descriptors()[0])) as ours:
            self.place = ours.getsockname()
        self.vehicle.connect(self.place)
        while stream and len(self.link.descriptors()) < 2:
            self.link.wait(0.02)
            self.link.receive()
        self.log = FlightLog(directory / "x", "", real_time=True)
        self.supervisor = Supervisor(self.signing)

    def beat(self, guard: Supervised) -> None:
        """Send a beat of the controller. The vehicle has just reported its mode."""
        known = replace(guard, reported_s=clock.monotonic_s())
        self.supervisor.beat(known, self.peer, self.link, self.log.descriptor)

    def abandon(self) -> None:
        """End as a killed controller does, whose descriptors the kernel closes."""
        self.supervisor._channel.close()
        self.link.close()

    def await_end(self) -> None:
        self.supervisor.process.wait(TIMEOUT_S)

    def next_message(self, kind: str = "COMMAND_LONG") -> Any:
        """Return the next message of this kind that the vehicle receives."""
        while True:
            for message in self.codec.parse_buffer(self.vehicle.recv(65536)) or []:
                if message.get_type() == kind:
                    return message

    def report(self, mode: int, *, armed: bool = True, status: int = 4, codec: Any = None) -> None:
        """Let the vehicle report its mode (`custom_mode` of PX4) and its MAV_STATE."""
        message = mavlink.MAVLink_heartbeat_message(2, 12, 129 if armed else 1, mode, status, 3)
        self.vehicle.send(message.pack(codec or self.codec))

    def disarm(self) -> None:
        """Let the vehicle report that it is disarmed, which ends the supervisor."""
        self.report(LANDING, armed=False)


def over(*kinds: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("rig", kinds, indirect=True)


@pytest.fixture
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path, getattr(request, "param", "udpin"))
    with rig.log, rig.supervisor:
        rig.supervisor.await_ready()
        yield rig
    rig.link.close()
    rig.vehicle.close()


@over("tcpin")
def test_supervisor_commands_the_newest_tcp_connection(rig: Rig) -> None:
    """One connection has ended, and another one begins after the controller has ended."""
    rig.beat(OURS)
    rig.vehicle.close()
    while len(rig.link.descriptors()) > 1:
        rig.link.wait(0.02)
        rig.link.receive()
    rig.beat(OURS)
    rig.abandon()
    rig.vehicle = socket.create_connection(rig.place)
    assert rig.next_message().command == 176
    rig.disarm()


@over("udpin")
def test_supervisor_commands_a_vehicle_on_a_new_port(rig: Rig) -> None:
    """A router restarts when the controller is killed."""
    rig.beat(OURS)
    rig.vehicle.close()
    rig.abandon()
    rig.vehicle = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    rig.vehicle.settimeout(0.2)
    rig.vehicle.connect(rig.place)

    def is_asked() -> bool:
        rig.report(OFFBOARD)
        with suppress(TimeoutError):
            return bool(rig.next_message().command == 176)
        return False

    eventually(is_asked)
    rig.disarm()
    rig.await_end()


@over("signed")
def test_supervisor_signs_with_later_stamps_than_the_controller(rig: Rig) -> None:
    ours = Session(SessionSettings(), rig.signing)
    ours.senders.set_vehicle(VEHICLE, "tcp")
    for _ in range(3):
        rig.beat(OURS)
        newest = ours.encode(Heartbeat(6))
    assert rig.codec.decode(bytearray(newest)).get_type() == "HEARTBEAT"
    assert KEY.hex() not in str(rig.supervisor.process.args)
    rig.abandon()
    command = rig.next_message()
    assert command.command == 176
    assert command.get_signed()
    forged = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
    rig.report(LANDING, armed=False, codec=forged)
    assert rig.next_message().command == 176  # it ignores the unsigned report
    rig.disarm()
    rig.await_end()
    assert all(each.frame.signed for each in tlog.read(rig.log.path) if each.name != "TUNNEL")


def test_supervisor_takes_over_when_the_beats_stop(rig: Rig) -> None:
    """Signals do not end it: a service manager signals all processes of a service."""
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        os.kill(rig.supervisor.process.pid, number)
    rig.beat(OURS)
    assert not rig.supervisor.has_taken_over()
    assert rig.next_message().command == 176
    assert rig.supervisor.has_taken_over()
    assert rig.supervisor.said[0] == "taking over: the controller has not answered for 0.9 s"
    rig.disarm()
    while not rig.supervisor.await_end(0.05):
        pass
    assert rig.supervisor.said[-1] == "the vehicle is disarmed"
    assert not rig.supervisor.lost


def test_flight_of_a_hung_and_killed_controller_is_scored(rig: Rig) -> None:
    """The watchdog of a service manager does this."""
    for entry in tlog.read(RECORDING):
        rig.log.write(entry.unix_us, entry.frame.raw)
    rig.beat(OURS)
    assert rig.next_message().command == 176
    rig.abandon()
    rig.disarm()
    rig.await_end()
    eventually(rig.log.path.with_name("score.json").exists)


def beat_until(rig: Rig, guards: bool, guard: Supervised) -> float:
    """Send beats until `Supervisor.guards` has this value. Return how long that took, in s."""
    began_s = clock.monotonic_s()
    while rig.supervisor.guards is not guards:
        assert clock.monotonic_s() < began_s + TIMEOUT_S
        rig.beat(guard)
        time.sleep(0.02)
        rig.supervisor.has_taken_over()  # reads its answer
    return clock.monotonic_s() - began_s


def test_stopped_supervisor_does_not_guard_until_it_continues(rig: Rig) -> None:
    """This shows within two seconds, on the ground and in flight. The supervisor does not take its
    own pause for a silence of the controller: it takes over not when it continues, but when beats
    stop."""
    for guard in (ON_GROUND, OURS):
        beat_until(rig, True, guard)
        os.kill(rig.supervisor.process.pid, signal.SIGSTOP)
        assert 0.9 < beat_until(rig, False, guard) < 2.0
        os.kill(rig.supervisor.process.pid, signal.SIGCONT)
        assert beat_until(rig, True, guard) < 1.0
    os.kill(rig.supervisor.process.pid, signal.SIGSTOP)
    time.sleep(1.2)  # both are stopped, and the controller wakes up later
    os.kill(rig.supervisor.process.pid, signal.SIGCONT)
    time.sleep(0.2)
    assert not rig.supervisor.has_taken_over()
    beat_until(rig, True, OURS)
    assert not rig.supervisor.has_taken_over()
    assert rig.next_message().command == 176
    rig.disarm()


def test_stopped_supervisor_recognises_the_vehicles_failsafe(rig: Rig) -> None:
    """Beats contain the time of the newest setpoint. Regression: counted from the time of
    reading, or of sending by a controller that was stopped within the turn, the failsafe seemed too
    early and so to be a pilot's choice."""
    known = replace(OURS, setpoint_loss=SetpointLoss(1.0, ("AUTO.LOITER",)))
    begun = replace(known, setpoint_s=clock.monotonic_s())
    os.kill(rig.supervisor.process.pid, signal.SIGSTOP)
    time.sleep(1.2)
    rig.beat(begun)
    rig.abandon()
    rig.report(LOITER, status=5)
    os.kill(rig.supervisor.process.pid, signal.SIGCONT)
    told = ""
    while "has it" not in told and "flies it" not in told:
        told += rig.next_message("STATUSTEXT").text
    assert "its own failsafe flies it" in told
    rig.disarm()


@over("udpin", "udpout")
def test_supervisor_waits_for_a_fresh_mode_report(rig: Rig) -> None:
    """This happens after a pause of the controller, or in an outage. Without a fresh report nothing
    is requested; hold is requested as soon as the vehicle shows our mode."""
    old = replace(OURS, reported_s=clock.monotonic_s() - 3.0)
    rig.supervisor.beat(old, rig.peer, rig.link, rig.log.descriptor)
    rig.abandon()
    rig.vehicle.settimeout(0.7)  # less than the period of HEARTBEAT
    with pytest.raises(TimeoutError):
        rig.next_message()
    rig.vehicle.settimeout(TIMEOUT_S)
    rig.report(OFFBOARD)
    assert rig.next_message().command == 176
    rig.disarm()


@pytest.mark.parametrize(
    "guard", [ON_GROUND, NOT_OURS, OURS], ids=["on ground", "not ours", "taken by a pilot"]
)
def test_supervisor_leaves_a_foreign_or_grounded_vehicle_alone(guard: Supervised, rig: Rig) -> None:
    """This is known from the newest beat; or from the newest report, which is read last, after more
    than one batch of datagrams."""
    rig.beat(OURS)
    rig.beat(guard)
    for mode in [OFFBOARD] * (BATCH_MAX + 50) + [POSCTL] if guard is OURS else []:
        rig.report(mode)
    rig.abandon()
    rig.await_end()
    rig.vehicle.settimeout(0.0)
    with pytest.raises(BlockingIOError):
        rig.next_message()


def test_killed_supervisor_is_noticed_and_replaced(rig: Rig) -> None:
    rig.beat(OURS)
    assert not rig.supervisor.lost
    os.kill(rig.supervisor.process.pid, signal.SIGKILL)
    rig.await_end()
    rig.beat(OURS)
    rig.beat(OURS)
    assert rig.supervisor.lost
    assert not rig.supervisor.has_taken_over()
    rig.supervisor.restart()
    rig.beat(OURS)
    assert not rig.supervisor.guards
    rig.supervisor.await_ready()
    assert rig.supervisor.guards
    rig.beat(OURS)
    assert rig.next_message().command == 176
    assert rig.supervisor.has_taken_over()
    rig.disarm()


def test_supervisor_without_a_controller_ends_silently() -> None:
    ours, its = socket.socketpair()
    ours.close()
    command = [sys.executable, "-P", "-m", "offboard.supervisor.process"]
    with its:
        ended = subprocess.run(
            command, stdin=its, capture_output=True, timeout=TIMEOUT_S, check=False
        )
    assert (ended.returncode, ended.stderr) == (0, b"")


def test_failed_start_of_the_supervisor_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """For example if there are too many processes. No descriptor is left open."""
    monkeypatch.setattr(sys, "executable", "/no/such/python")
    supervisor = Supervisor()
    before = os.listdir("/proc/self/fd")
    with (
        pytest.raises(Unavailable, match="does not start: No such file") as refused,
        supervisor,
    ):
        pass
    assert refused.value.code == 3
    assert os.listdir("/proc/self/fd") == before
