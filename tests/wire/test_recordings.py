"""Recordings of real autopilots: the events that the session must find in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink
from vehicle_frames import ARDUCOPTER_RECORDING, PX4_RECORDING, recorded

from offboard.mavlink import events
from offboard.mavlink.counters import DropReason
from offboard.mavlink.session import Session, SessionSettings

PEER = "recorded"


class Replay:
    """A recording, received by a session frame by frame."""

    def __init__(self, path: Path) -> None:
        self.messages = list(recorded(path))
        self.session = Session(SessionSettings())
        self.events: list[tuple[float, events.Event]] = []
        self.logged: list[bytes] = []
        start_s = self.messages[0]._timestamp
        for message in self.messages:
            time_s = message._timestamp - start_s
            reception = self.session.receive(bytes(message.get_msgbuf()), PEER, time_s)
            self.events += [(time_s, event) for event in reception.events]
            self.logged += reception.frames

    def of(self, kind: type) -> list[Any]:
        return [event for _, event in self.events if isinstance(event, kind)]

    def transitions(self) -> list[tuple[str, bool, int]]:
        states: list[tuple[str, bool, int]] = []
        for beat in self.of(events.Heartbeat):
            state = (beat.mode, beat.armed, beat.system_status)
            if not states or states[-1] != state:
                states.append(state)
        return states

    def acks(self) -> list[tuple[int, str]]:
        return [(ack.command, ack.result) for ack in self.of(events.CommandAck)]


@pytest.fixture(scope="module")
def px4() -> Replay:
    return Replay(PX4_RECORDING)


@pytest.fixture(scope="module")
def arducopter() -> Replay:
    return Replay(ARDUCOPTER_RECORDING)


@pytest.fixture(params=["px4", "arducopter"])
def replay(request: pytest.FixtureRequest) -> Replay:
    found: Replay = request.getfixturevalue(request.param)
    return found


def known(frame: bytes) -> bool:
    return int.from_bytes(frame[7:10], "little") in mavlink.mavlink_map


def test_every_byte_is_framed_and_no_frame_is_lost(replay: Replay) -> None:
    counters = replay.session.counters
    ours = [m for m in replay.messages if m.get_msgbuf()[6] == 191]
    assert counters.bytes_framed == sum(len(m.get_msgbuf()) for m in replay.messages)
    assert counters.bytes_skipped == counters.bytes_pending == 0
    assert counters.frames == len(replay.messages)
    assert counters.dropped[DropReason.SAME_IDS] == len(ours)
    others = {DropReason.SAME_IDS, DropReason.NO_VEHICLE, DropReason.NOT_FOR_US}
    others.add(DropReason.UNKNOWN_ID)  # EVENT and others that pymavlink does not know
    assert set(counters.dropped) <= others
    assert replay.logged == [
        bytes(m.get_msgbuf())
        for m in replay.messages
        if m.get_msgbuf()[6] != 191 and known(m.get_msgbuf())
    ]


def test_positions_and_attitudes_are_what_pymavlink_reads(replay: Replay) -> None:
    beats = (m for m in replay.messages if m.get_type() == "HEARTBEAT")
    first = next(m for m in beats if m.get_srcComponent() == 1)
    heard = replay.messages[replay.messages.index(first) :]
    positions = [
        events.LocalPosition(m.time_boot_ms / 1000.0, (m.x, m.y, m.z), (m.vx, m.vy, m.vz))
        for m in heard
        if m.get_type() == "LOCAL_POSITION_NED"
    ]
    assert len(positions) > 2600
    assert replay.of(events.LocalPosition) == positions
    attitudes = replay.of(events.Attitude)
    messages = [m for m in heard if m.get_type() == "ATTITUDE_QUATERNION"]
    assert len(attitudes) == len(messages) in (3488, 0)  # ArduCopter was not asked for it
    for attitude, message in zip(attitudes, messages, strict=True):
        sent = (message.q1, message.q2, message.q3, message.q4)
        assert attitude.attitude == pytest.approx(sent, abs=1e-6)
        rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
        assert attitude.rates_frd_radps == rates


def test_px4_tells_its_modes_answers_and_texts(px4: Replay) -> None:
    assert px4.session.vehicle == events.VehicleFound(7, 1, "px4")
    assert px4.transitions() == [
        ("AUTO.LOITER", False, 0),
        ("AUTO.LOITER", False, 3),
        ("OFFBOARD", False, 0),  # asked for without a stream: accepted, and unhealthy
        ("OFFBOARD", False, 3),
        ("OFFBOARD", True, 4),
        ("POSCTL", True, 5),  # the stream stopped
        ("OFFBOARD", True, 4),  # and resumed, without a request
        ("AUTO.LOITER", True, 4),
        ("POSCTL", True, 5),  # OFFBOARD without a stream, in the air
        ("AUTO.LAND", True, 4),
        ("OFFBOARD", False, 0),  # reverts after disarming
    ]
    modes, intervals = [(176, "ACCEPTED")] * 2, [(511, "ACCEPTED")] * 2  # modes: twice each
    armed, rejected = (400, "ACCEPTED"), (400, "TEMPORARILY_REJECTED")
    landing = (21, "ACCEPTED")
    assert px4.acks() == [
        *modes, rejected, *intervals, *modes, armed, rejected, *modes, *modes, landing
    ]  # fmt: skip
    texts = [(event.severity, event.text) for event in px4.of(events.StatusText)]
    assert texts == [
        (6, "[logger] ./log/2026-11-20/22_33_27.ulg"),
        (2, "Arming denied: Resolve system health failures first"),  # two chunks
        (6, "Armed by external command"),
        (6, "Takeoff detected"),
        (2, "Failsafe activated"),
        (2, "Disarming denied: not landed"),
        (2, "Failsafe activated"),
        (6, "Landing at current position"),
        (6, "Landing detected"),
        (6, "Disarmed by landing"),
    ]


def test_arducopter_tells_its_modes_answers_and_texts(arducopter: Replay) -> None:
    assert arducopter.session.vehicle == events.VehicleFound(1, 1, "ardupilot")
    assert arducopter.transitions() == [
        ("STABILIZE", False, 1),
        ("STABILIZE", False, 3),
        ("GUIDED", False, 3),
        ("GUIDED", True, 3),
        ("GUIDED", True, 4),  # stays through four seconds without a stream
        ("LAND", True, 4),
        ("LAND", True, 3),
        ("LAND", False, 3),
    ]
    assert [ack for ack in arducopter.acks() if ack[0] not in (511, 512)] == [
        (400, "FAILED"),  # not initialised
        (176, "ACCEPTED"),
        (22, "FAILED"),  # takeoff while disarmed
        (400, "FAILED"),
        (176, "FAILED"),  # mode 99
        (400, "FAILED"),  # at 25 s: no position
        (400, "ACCEPTED"),
        (22, "ACCEPTED"),
        (400, "FAILED"),  # disarm in the air
        (21, "ACCEPTED"),
    ]
    assert arducopter.acks().count((511, "ACCEPTED")) == 16
    told = [event.text for event in arducopter.of(events.StatusText)]
    assert len(told) == 32
    assert told[-1] == "Disarming motors"
    assert {"No such mode 99", "Arm: Need Position Estimate", "ArduPilot Ready"} <= set(told)


def test_parameters_are_bytewise_on_px4_and_cast_on_arducopter(
    px4: Replay, arducopter: Replay
) -> None:
    assert {p.name: p.value for p in px4.of(events.Parameter)} == {
        "MPC_THR_HOVER": 0.5,
        "COM_OF_LOSS_T": 1.0,
        "COM_OBL_RC_ACT": 0.0,
        "COM_RC_IN_MODE": 1.0,  # INT32: 1.4e-45 if it were read as a float
        "NAV_DLL_ACT": 0.0,
        "COM_RCL_EXCEPT": 0.0,
    }
    last = {p.name: p.value for p in arducopter.of(events.Parameter)}
    assert (last["GUID_OPTIONS"], last["ATC_ANGLE_BOOST"], last["SYSID_MYGCS"]) == (8.0, 1.0, 255.0)
    assert last["MOT_THST_HOVER"] == pytest.approx(0.39)


@pytest.mark.parametrize("portion", [1, 64])
def test_a_stream_in_any_portions_gives_the_same_events(px4: Replay, portion: int) -> None:
    messages = px4.messages[:1500]
    data = b"".join(bytes(m.get_msgbuf()) for m in messages)
    whole, pieces = Session(SessionSettings()), Session(SessionSettings(stream=True))
    expected = [e for m in messages for e in whole.receive(bytes(m.get_msgbuf()), PEER, 0.0).events]
    found = []
    for at in range(0, len(data), portion):
        found += pieces.receive(data[at : at + portion], PEER, 0.0).events
    assert len(expected) > 200
    assert found == expected
    assert pieces.counters.frames == 1500
    assert pieces.counters.bytes_skipped == 0
