"""The supervisor on a real link to a vehicle that only listens: when it acts, and when not.

Flights that it saves are in tests/process/test_controller_lost.py.
"""

from __future__ import annotations

import itertools
import os
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from offboard.analysis import tlog
from offboard.flight.flight import Output
from offboard.flight.phases import Phase
from offboard.link import clock
from offboard.link.connection import open_link
from offboard.link.interface import Chunk
from offboard.link.log import FlightLog
from offboard.link.stop import StopRequests
from offboard.link.udp import BATCH_MAX
from offboard.mavlink.events import VehicleFound
from offboard.mavlink.outgoing import Heartbeat
from offboard.mavlink.session import Session, SessionSettings
from offboard.mavlink.signing import Signing
from offboard.run.loop import Loop
from offboard.supervisor.recovery import Supervised
from offboard.supervisor.supervisor import Supervisor, SupervisorError

LONG_S = 20.0
OFFBOARD, POSCTL, LANDING, HOLDING = 0x00060000, 0x00030000, 0x06040000, 0x03040000
VEHICLE = VehicleFound(7, 1, "px4")
OURS, ON_GROUND, NOT_OURS = (
    Supervised(VEHICLE, ours=True, flying=True),
    Supervised(VEHICLE, ours=True, flying=False),
    Supervised(VEHICLE, ours=False, flying=True),
)


def now(guard: Supervised) -> Supervised:
    """The vehicle has just reported its mode."""
    return replace(guard, reported_s=clock.monotonic_s())


def abandon(supervisor: Supervisor, link: Any) -> None:
    """End as a controller that is killed: the kernel closes its descriptors."""
    supervisor._channel.close()
    link.close()


def await_end(supervisor: Supervisor) -> None:
    supervisor._process.wait(LONG_S)


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

    def beat(self, guard: Supervised) -> None:
        self.supervisor.beat(now(guard), self.peer, self.link, self.log.descriptor)

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

    def report(self, place: Any, mode: int, *, armed: bool = True) -> None:
        """The vehicle reports its mode, as custom mode of PX4, to `place`."""
        codec = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
        message = mavlink.MAVLink_heartbeat_message(2, 12, 129 if armed else 1, mode, 4, 3)
        self.vehicle.sendto(message.pack(codec), place)

    def acknowledge(self, place: Any) -> None:
        """The vehicle accepts the change of its mode."""
        ack = mavlink.MAVLink_command_ack_message(176, 0)
        self.vehicle.sendto(ack.pack(mavlink.MAVLink(None, srcSystem=7, srcComponent=1)), place)

    def disarm(self) -> None:
        """The vehicle reports that it is down, which ends the supervisor."""
        self.report(self.sender, LANDING, armed=False)


BOTH_WAYS = pytest.mark.parametrize("rig", ["udpin", "udpout"], indirect=True)


@pytest.fixture
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path, getattr(request, "param", "udpin"))
    with rig.log, rig.supervisor:
        rig.supervisor.await_ready()
        yield rig
    rig.link.close()
    rig.vehicle.close()


@BOTH_WAYS
def test_it_takes_over_when_the_controller_ends(rig: Rig) -> None:
    rig.beat(ON_GROUND)
    rig.beat(OURS)
    abandon(rig.supervisor, rig.link)
    command = rig.next_command()
    assert (command.command, command.param2, command.param3) == (176, 4.0, 3.0)  # AUTO.LOITER
    assert (command.target_system, command.get_srcSystem()) == (7, 7)
    rig.disarm()
    await_end(rig.supervisor)
    texts = [entry.message.text for entry in tlog.read(rig.log.path)
             if entry.name == "STATUSTEXT"]  # fmt: skip
    said = "".join(texts)
    assert said.startswith("supervisor: taking over: the controller ended in flight")
    assert said.endswith("supervisor: the vehicle is disarmed")


def test_it_takes_over_when_the_beats_stop_and_says_so_first(rig: Rig) -> None:
    """Signals do not end it: a service manager signals all processes of a service."""
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        os.kill(rig.supervisor.pid, number)
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


class Beating:
    """A companion whose vehicle is ours; counts what the loop read for it."""

    phase, outcome, announced = Phase.TRACK, None, ()
    other_datagrams = read = 0

    def __init__(self, peer: Any) -> None:
        self.peer = peer

    @property
    def current(self) -> Beating:
        return self

    def turn(self, chunks: Sequence[Chunk], now_s: float) -> Output:
        self.read += len(chunks)
        return Output(supervised=now(OURS))

    def has_ended(self) -> bool:
        return False

    def __getattr__(self, name: str) -> Any:  # no other call returns anything
        return lambda *arguments: ()


def test_a_stopped_controller_leaves_the_answers_to_the_supervisor(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is stopped while it waits for telemetry. Both processes read the same link, and the
    acknowledgement of hold arrives before it continues: it must not read it."""
    wait, turns = select.select, itertools.count()

    def holds() -> None:
        time.sleep(0.2)
        os.kill(rig.supervisor.pid, signal.SIGCONT)
        for _ in range(10):
            rig.report(rig.sender, HOLDING)
            time.sleep(0.1)
        rig.disarm()

    vehicle = threading.Thread(target=holds)

    def stops(*arguments: Any) -> Any:
        ready = wait(*arguments)
        if next(turns) == 30:
            assert rig.next_command().command == 176
            os.kill(rig.supervisor.pid, signal.SIGSTOP)  # the controller continues first
            rig.acknowledge(rig.sender)
            vehicle.start()
        return ready

    monkeypatch.setattr(select, "select", stops)
    flown: Any = Beating(rig.peer)
    with StopRequests() as requested:
        outcome = Loop(
            flown, rig.link, rig.log, stops=requested, progress=print, supervisor=rig.supervisor
        ).run()
    assert outcome.sentence.endswith("hold requested; the vehicle is disarmed")
    assert flown.read == 0
    vehicle.join()
    assert "COMMAND_LONG" not in [each.get_type() for each in rig.heard()]


def test_one_that_is_stopped_does_not_guard_until_it_continues(rig: Rig) -> None:
    """Within two seconds, on the ground and in flight, where it does not take over. The loop
    announces it: see test_edges.py."""

    def beat_until(guards: bool, guard: Supervised) -> float:
        began_s = clock.monotonic_s()
        while rig.supervisor.guards is not guards:
            assert clock.monotonic_s() < began_s + LONG_S
            rig.beat(guard)
            time.sleep(0.02)
            rig.supervisor.has_taken_over()  # reads its answer
        return clock.monotonic_s() - began_s

    for guard in (ON_GROUND, OURS):
        beat_until(True, guard)
        os.kill(rig.supervisor.pid, signal.SIGSTOP)
        assert 0.9 < beat_until(False, guard) < 2.0
        os.kill(rig.supervisor.pid, signal.SIGCONT)
        assert beat_until(True, guard) < 1.0
    assert not rig.supervisor.has_taken_over()


def test_a_pause_of_its_own_is_no_silence_of_the_controller(rig: Rig) -> None:
    """Both are stopped, as on a computer that sleeps, and the controller wakes up later."""
    for _ in range(5):
        rig.beat(OURS)
        time.sleep(0.02)
    time.sleep(0.1)  # it has read all beats
    os.kill(rig.supervisor.pid, signal.SIGSTOP)
    time.sleep(1.2)
    os.kill(rig.supervisor.pid, signal.SIGCONT)
    time.sleep(0.2)
    assert not rig.supervisor.has_taken_over()
    rig.beat(OURS)
    while not rig.supervisor.guards:
        time.sleep(0.01)
        rig.supervisor.has_taken_over()  # reads its answer
    assert not rig.supervisor.has_taken_over()
    assert rig.next_command().command == 176  # as the beats stop
    rig.disarm()


def test_the_report_of_the_mode_may_be_old_and_is_awaited_then(rig: Rig) -> None:
    """As after a pause of the controller, or in an outage: nothing is asked of a vehicle of which
    no report is fresh, and hold as soon as it shows our mode."""
    old = replace(OURS, reported_s=clock.monotonic_s() - 3.0)
    rig.supervisor.beat(old, rig.peer, rig.link, rig.log.descriptor)
    abandon(rig.supervisor, rig.link)
    rig.vehicle.settimeout(1.0)
    with pytest.raises(TimeoutError):
        rig.next_command()
    rig.vehicle.settimeout(LONG_S)
    rig.report(rig.sender, OFFBOARD)
    assert rig.next_command().command == 176
    rig.disarm()


@pytest.mark.parametrize("guard", [ON_GROUND, NOT_OURS])
def test_a_vehicle_that_is_not_ours_or_on_the_ground_is_left_alone(
    guard: Supervised, rig: Rig
) -> None:
    rig.beat(OURS)
    rig.beat(guard)
    abandon(rig.supervisor, rig.link)
    await_end(rig.supervisor)
    assert rig.heard() == []


def test_the_newest_of_what_has_waited_decides(rig: Rig) -> None:
    """While it waited for beats the vehicle has sent more than one batch, and left for POSCTL."""
    rig.beat(OURS)
    place = ("127.0.0.1", rig.link.port)
    for _ in range(BATCH_MAX + 50):
        rig.report(place, OFFBOARD)
    rig.report(place, POSCTL)
    abandon(rig.supervisor, rig.link)
    await_end(rig.supervisor)
    assert [each for each in rig.heard() if each.get_type() == "COMMAND_LONG"] == []


# --- other links, and signing ---


class Caller:
    """A vehicle that connects to us over TCP."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port))
        self.socket.settimeout(LONG_S)

    def asked(self, codec: Any) -> Any:
        """The next COMMAND_LONG."""
        while True:
            data = self.socket.recv(65536)
            assert data, "disconnected"
            for message in codec.parse_buffer(data) or []:
                if message.get_type() == "COMMAND_LONG":
                    return message


def listening() -> tuple[Any, int]:
    """A link to which a vehicle connects, and its port."""
    link = open_link("tcpin:127.0.0.1:0")
    with socket.socket(fileno=os.dup(link.descriptors()[0])) as listener:
        return link, listener.getsockname()[1]


def await_connections(link: Any, count: int) -> None:
    while len(link.descriptors()) != 1 + count:
        link.receive(0.02)


@pytest.mark.parametrize("returns", ["before", "after"])
def test_over_tcpin_it_asks_the_vehicle_that_connected_last(returns: str, tmp_path: Path) -> None:
    """A connection that ended, and one that begins before or after the controller ended."""
    link, port = listening()
    with FlightLog(tmp_path / "x", "", real_time=True) as log, Supervisor() as supervisor:
        supervisor.await_ready()
        first = Caller(port)
        await_connections(link, 1)
        supervisor.beat(now(OURS), "tcp", link, log.descriptor)
        first.socket.close()
        await_connections(link, 0)
        supervisor.beat(now(OURS), "tcp", link, log.descriptor)
        if returns == "before":
            second = Caller(port)
            await_connections(link, 1)
            supervisor.beat(now(OURS), "tcp", link, log.descriptor)
        abandon(supervisor, link)
        if returns == "after":
            second = Caller(port)
        assert second.asked(mavlink.MAVLink(None)).command == 176
        second.socket.close()
        os.kill(supervisor.pid, signal.SIGKILL)


def test_it_signs_with_stamps_that_follow_ours(tmp_path: Path) -> None:
    key = bytes(range(32))
    signing = Signing(key, 10**12, clock.monotonic_s)
    ours = Session(SessionSettings(), signing)
    ours.set_vehicle(VEHICLE, "tcp")
    link, port = listening()
    vehicle = Caller(port)
    reader = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
    reader.signing.secret_key, reader.signing.sign_outgoing = key, True
    reader.signing.timestamp = 10**12
    with FlightLog(tmp_path / "x", "", real_time=True) as log, Supervisor(signing) as supervisor:
        supervisor.await_ready()
        await_connections(link, 1)
        for _ in range(3):
            supervisor.beat(now(OURS), "tcp", link, log.descriptor)
            newest = ours.encode(Heartbeat(6))
        assert reader.decode(bytearray(newest)).get_type() == "HEARTBEAT"
        assert key.hex() not in str(supervisor._process.args)
        abandon(supervisor, link)
        command = vehicle.asked(reader)
        assert command.command == 176
        assert command.get_signed()
        disarmed = mavlink.MAVLink_heartbeat_message(2, 12, 1, 0x06040000, 3, 3)
        forged = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
        vehicle.socket.sendall(disarmed.pack(forged))
        assert vehicle.asked(reader).command == 176  # it does not believe that
        vehicle.socket.sendall(disarmed.pack(reader))
        await_end(supervisor)
    vehicle.socket.close()
    assert all(each.frame.signed for each in tlog.read(log.path) if each.name != "TUNNEL")


def test_a_supervisor_that_ends_is_noticed_and_another_one_takes_over(rig: Rig) -> None:
    rig.beat(OURS)
    assert not rig.supervisor.lost
    os.kill(rig.supervisor.pid, signal.SIGKILL)
    await_end(rig.supervisor)
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
    assert rig.next_command().command == 176
    assert rig.supervisor.has_taken_over()
    rig.disarm()


def test_a_supervisor_that_cannot_be_started_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """As with too many processes; nothing is left open."""
    monkeypatch.setattr(sys, "executable", "/no/such/python")
    supervisor = Supervisor()
    before = os.listdir("/proc/self/fd")
    with (
        pytest.raises(SupervisorError, match="does not start: No such file or directory"),
        supervisor,
    ):
        pass
    assert os.listdir("/proc/self/fd") == before
