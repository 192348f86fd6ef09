"""The session: which sender is the vehicle, what is dropped and why, what is sent."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_frames import ARDUPILOT, OFFBOARD, PEER, PX4, Sender, pinned, understood

from offboard.mavlink import events
from offboard.mavlink.outgoing import Heartbeat
from offboard.mavlink.session import Session, SessionSettings

STRANGER = ("10.0.0.9", 4000)
RESTARTED = (PEER[0], 50123)


# --- which sender is the vehicle ---


def ignores(session: Session, *frames: bytes) -> None:
    """Each frame must give no event and be logged."""
    for frame in frames:
        reception = session.receive(frame, PEER, 0.0)
        assert (reception.events, reception.frames) == ([], [frame])


def test_only_the_first_autopilot_heard_is_the_vehicle() -> None:
    session, vehicle = Session(SessionSettings()), Sender(42)
    ignores(
        session,
        Sender().position(1000),
        Sender(255, 190).heartbeat(8, vehicle_type=6),
        Sender(255, 1).heartbeat(8, vehicle_type=6),
        Sender(255, 1).heartbeat(PX4, vehicle_type=6),
        Sender(1, 154).heartbeat(8, vehicle_type=26),
        Sender().heartbeat(0),
    )
    assert session.poll(0.0) == ()  # nothing is sent before a vehicle is found
    reception = session.receive(vehicle.heartbeat(), PEER, 0.0)
    assert reception.events == [
        events.VehicleFound(42, 1, "px4"),
        events.Heartbeat("OFFBOARD", False, 3, 2),
    ]
    ours = session.encode(Heartbeat(18))
    assert ours[5:7] == bytes([42, 191])
    echo = session.receive(ours, PEER, 0.0)  # neither heard nor logged
    assert (echo.frames, echo.events, echo.unlogged) == ([], [], [])
    ignores(
        session,
        Sender(2).position(1000),
        Sender(42, 154).position(1000),
        vehicle.heartbeat(ARDUPILOT),
        vehicle.heartbeat(8),
    )
    assert len(session.receive(vehicle.position(1000), PEER, 0.0).events) == 1


def test_vehicle_on_a_new_port_is_not_a_duplicate() -> None:
    """Its HEARTBEAT came from the new port before the old one had been silent for long enough."""
    vehicle = Sender(1)
    session = pinned(vehicle)
    session.receive(vehicle.position(1000), PEER, 10.0)
    assert session.senders.overhear(vehicle.heartbeat(), session.link_time_s) == [1]
    assert "system 1 from another address" in session.senders.twin(session.link_time_s)
    session.receive(vehicle.position(1020), RESTARTED, 10.6)
    assert (session.peer, session.senders.twin(session.link_time_s)) == (RESTARTED, "")


@pytest.mark.parametrize(
    ("sender", "place", "silence_s"),
    [
        (Sender(1), RESTARTED, 0.5),
        (Sender(1), STRANGER, 60.0),
        (Sender(2), RESTARTED, 60.0),
        (Sender(1, 154), RESTARTED, 60.0),
    ],
)
def test_no_other_sender_replaces_the_vehicle(
    sender: Sender, place: tuple[str, int], silence_s: float
) -> None:
    """It sends while the vehicle does, from another host, or as another system or component."""
    vehicle = Sender(1)
    session = pinned(vehicle)
    session.receive(vehicle.position(1000), PEER, 10.0)
    for data in (sender.heartbeat(), sender.position(1020), b"\xfd nonsense"):
        session.senders.overhear(data, session.link_time_s)
        reception = session.receive(data, place, 10.0 + silence_s)
        assert (reception.events, reception.frames) == ([], [])
    other = sender.ids == (2, 1)
    assert ("from 2; see" in session.senders.others(session.link_time_s)) == other
    assert len(session.receive(vehicle.position(1040), PEER, 99.0).events) == 1


# --- other controllers ---


def level_setpoint(target: int) -> Any:
    return mavlink.MAVLink_set_attitude_target_message(0, target, 1, 7, [1, 0, 0, 0], 0, 0, 0, 0.5)


def test_other_controllers_on_the_link_are_detected() -> None:
    """A companion that uses our ids is seen, and so is a component of the vehicle's system that
    sends setpoints or mode commands. One that requests a parameter or a rate is no controller."""
    session = pinned(Sender())
    twin, other = Sender(1, 191), Sender(1, 195)
    beat = twin.heartbeat(8, 7, vehicle_type=18)
    reception = session.receive(beat, PEER, 0.0)
    assert reception.events == [events.OtherCompanion(1, 191, 7)]
    assert (reception.frames, reception.unlogged) == ([], [(0, beat)])
    land, rate = (mavlink.MAVLink_command_long_message(1, 1, n, 0, *[0] * 7) for n in (21, 511))
    read = mavlink.MAVLink_param_request_read_message(1, 1, b"MPC_THR_HOVER", -1)
    for sender in (twin, other):
        seen = [events.OtherSender(*sender.ids)]
        assert session.receive(sender.frame(land), PEER, 0.0).events[:1] == seen
        assert session.receive(sender.frame(rate) + sender.frame(read), PEER, 0.0).events == []
    assert session.receive(Sender(255, 190).frame(land), PEER, 0.0).events == []  # the pilot's
    elsewhere, to_us = (
        mavlink.MAVLink_command_long_message(*ids, 21, 0, *[0] * 7) for ids in ((2, 1), (1, 191))
    )
    assert session.receive(other.frame(elsewhere), PEER, 0.0).events == []
    assert session.receive(twin.frame(to_us), PEER, 0.0).events == []  # our own ids
    assert session.receive(other.frame(level_setpoint(1)), PEER, 0.0).events == [
        events.OtherSender(1, 195)
    ]


@pytest.mark.parametrize(("target", "seen"), [(0, True), (1, True), (2, False)])
def test_setpoints_for_another_vehicle_are_ignored(target: int, seen: bool) -> None:
    session, zeros = pinned(Sender()), (0,) * 12
    for setpoint in (
        level_setpoint(target),
        mavlink.MAVLink_set_position_target_local_ned_message(0, target, 1, 1, *zeros),
        mavlink.MAVLink_set_position_target_global_int_message(0, target, 1, 5, *zeros),
    ):
        received = session.receive(Sender(255, 190).frame(setpoint), PEER, 0.0).events
        assert bool(received) is seen


def accepted_modes(arrivals: list[tuple[float, int, bytes]], session: Session) -> list[int]:
    """Numbers of the accepted reports of the mode among frames (time of arrival, number, bytes)."""
    receptions = [session.receive(frame, PEER, at_s) for at_s, _, frame in sorted(arrivals)]
    heard = [event for reception in receptions for event in reception.events]
    modes = [event.mode for event in heard if isinstance(event, events.Heartbeat)]
    return [int(mode.removeprefix("UNKNOWN(0xff").removesuffix(")"), 16) for mode in modes]


def mode_reports(
    rng: np.random.Generator, rate_hz: float, vehicle: Sender
) -> list[tuple[float, int, bytes]]:
    """20 s of frames at `rate_hz`, a HEARTBEAT with the next mode each second: (time when it is
    sent, number of the report or -1 for another message, bytes)."""
    frames, reports = [], 0
    for k in range(int(20 * rate_hz)):
        sent_s = 1.0 + k / rate_hz
        if sent_s >= 1.0 + reports + rng.uniform(0.0, 0.2):
            frames.append((sent_s, reports, vehicle.heartbeat(custom_mode=0xFF000000 + reports)))
            reports += 1
        else:
            frames.append((sent_s, -1, vehicle.position(round(1e3 * sent_s))))
    return frames


@pytest.mark.parametrize("seed", range(5))
def test_overtaken_mode_reports_are_dropped(seed: int) -> None:
    """It is up to 127 frames and 1.2 s late. Reports in order count; 5 % of others are lost."""
    rng = np.random.default_rng(seed)
    vehicle = Sender(1)
    session = pinned(vehicle)
    frames = mode_reports(rng, rng.uniform(40.0, 100.0), vehicle)
    late = rng.choice([number for _, number, _ in frames if 0 < number < 18], 5, replace=False)
    arrivals = [
        (sent_s + (rng.uniform(0.3, 1.2) if number in late else 0.0), number, frame)
        for sent_s, number, frame in frames
        if number >= 0 or rng.uniform() > 0.05
    ]
    accepted = accepted_modes(arrivals, session)
    assert accepted == sorted(accepted)
    assert set(accepted) >= {number for _, number, _ in frames} - {-1, *late}


@pytest.mark.parametrize("seed", range(5))
def test_mode_reports_count_after_outages_and_restarts(seed: int) -> None:
    """A pilot's switch is not taken for an old report, whatever was lost before it."""
    rng = np.random.default_rng(seed)
    vehicle = Sender(1)
    session = pinned(vehicle)
    arrivals, end_s = [], 0.0
    for sent_s, number, frame in mode_reports(rng, rng.uniform(10.0, 480.0), vehicle):
        if rng.uniform() < 0.01:
            end_s = sent_s + rng.exponential(0.5)
        if sent_s >= end_s:
            arrivals.append((sent_s, number, frame))
    assert accepted_modes(arrivals, session) == [n for _, n, _ in arrivals if n >= 0]
    rebooted = Sender(1).heartbeat(custom_mode=2 << 16)  # counts from 0 again
    (event, *_) = session.receive(rebooted, PEER, arrivals[-1][0] + 1.0).events
    assert isinstance(event, events.Heartbeat)


def test_another_companion_computer_is_detected() -> None:
    session = pinned(Sender(1))
    for ids, vehicle_type, autopilot, seen in (
        ((1, 192), 18, 8, True),
        ((7, 191), 18, 8, False),  # of another vehicle
        ((1, 192), 6, 8, True),  # as a companion of PX4 calls itself
        ((255, 190), 6, 8, False),
        ((1, 154), 26, 8, False),
        ((2, 1), 2, PX4, False),
    ):
        beat = Sender(*ids).heartbeat(autopilot, vehicle_type=vehicle_type)
        expected = [events.OtherCompanion(*ids, OFFBOARD)] if seen else []
        assert session.receive(beat, PEER, 1.0).events == expected, ids


def test_acks_for_other_programs_are_ignored() -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    for address, ours in (
        ((255, 190), False), ((1, 190), False), ((2, 191), False), ((1, 191), True), ((0, 0), True)
    ):  # fmt: skip
        found = session.receive(vehicle.ack(400, 0, *address), PEER, 0.0).events
        assert found == ([events.CommandAck(400, "ACCEPTED")] if ours else [])


# --- what is sent ---


def test_only_a_simulator_in_lockstep_gets_timesync_replies() -> None:
    """Also before its first HEARTBEAT, and without the setting once it repeats its request. PX4
    would take our clock for that of a program that sends it external vision."""
    vehicle, session = Sender(7), Session(SessionSettings(lockstep=True))
    live = Session(SessionSettings())
    for now_ns in (0, 2_500_000_000):
        request = mavlink.MAVLink_timesync_message(0, 123_456_789_012 + now_ns)
        (answer,) = session.receive(vehicle.frame(request), PEER, 0.0).replies
        reply = understood(session.encode(answer))
        assert (reply.tc1, reply.ts1) == (1, 123_456_789_012 + now_ns)
        assert session.receive(Sender(255, 190).frame(request), PEER, 0.0).replies == []
        assert live.receive(vehicle.frame(request), PEER, 0.0).replies == []
        for each in (session, live):
            each.receive(vehicle.heartbeat(), PEER, 0.0)
    replies = [live.receive(vehicle.frame(request), PEER, 0.0).replies for _ in range(3)]
    assert [len(each) for each in replies] == [0, 0, 1]
    theirs = vehicle.frame(mavlink.MAVLink_timesync_message(1, 2))
    reception = session.receive(theirs, PEER, 2.5)
    assert reception.replies == []
    assert reception.events == [events.TimesyncReply(request_ns=2, vehicle_ns=1)]


def test_heartbeat_rate_is_1_hz_of_the_faster_clock() -> None:
    """A further one, with the vehicle's system id, is sent as soon as the vehicle is found."""
    vehicle, session = Sender(7), Session(SessionSettings(sends_first=True))
    assert session.poll(0.0) == (Heartbeat(18),)
    session.receive(vehicle.heartbeat(), PEER, 0.5)
    (beat, *_) = session.poll(0.5)
    assert session.encode(beat)[5:7] == bytes([7, 191])
    sent = [0.1 * i for i in range(6, 106) if Heartbeat(18) in session.poll(0.1 * i)]
    assert sent == pytest.approx([1.5 + i for i in range(10)])
    beats = 0
    for tick in range(1, 1002):  # ten seconds of vehicle time in 0.2 s of host time
        session.receive(vehicle.position(10 * tick), PEER, 10.5 + 0.0002 * tick)
        beats += Heartbeat(18) in session.poll(10.5 + 0.0002 * tick)
    assert beats == 10


def test_changed_custom_mode_sends_a_heartbeat_at_once() -> None:
    session = Session(SessionSettings(sends_first=True))
    status = [(3, 1), (3, 1), (4, 1), (4, 6), (4, 6), (4, 1)]
    sent = [session.poll(0.01 * i, each) for i, each in enumerate(status)]
    assert sent == [
        (Heartbeat(18, 3, 1),),
        (),
        (),
        (Heartbeat(18, 4, 6),),
        (),
        (Heartbeat(18, 4, 1),),
    ]
