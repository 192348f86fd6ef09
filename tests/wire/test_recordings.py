"""Recordings of real autopilots: the events that the session must find in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import all as mavlink
from vehicle_frames import ARDUCOPTER_RECORDING, PX4_RECORDING, recorded

from offboard.mavlink import events
from offboard.mavlink.session import Session, SessionSettings

PEER = "recorded"


class Replay:
    """A recording, received by a session frame by frame."""

    def __init__(self, path: Path) -> None:
        frames = recorded(path)
        self.messages = [message for _, _, message in frames]
        self.session = Session(SessionSettings())
        self.events: list[tuple[float, events.Event]] = []
        self.logged: list[bytes] = []
        for time_s, frame, _ in frames:
            reception = self.session.receive(frame, PEER, time_s)
            self.events += [(time_s, event) for event in reception.events]
            self.logged += reception.frames

    def of(self, kind: type) -> list[Any]:
        return [event for _, event in self.events if isinstance(event, kind)]

    def heard(self, *kinds: str) -> list[Any]:
        """Messages of the autopilot, from its first heartbeat on, as pymavlink reads them."""
        ours = [m for m in self.messages if m.get_srcComponent() == 1]
        first = next(n for n, m in enumerate(ours) if m.get_type() == "HEARTBEAT")
        return [m for m in ours[first:] if m.get_type() in kinds]


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
    """EVENT and others that pymavlink does not know are framed, but not logged, nor are ours."""
    splitter = replay.session.splitter
    assert splitter.bytes_received == sum(len(m.get_msgbuf()) for m in replay.messages)
    assert (splitter.bytes_skipped, splitter.frames) == (0, len(replay.messages))
    assert replay.logged == [
        bytes(m.get_msgbuf())
        for m in replay.messages
        if m.get_msgbuf()[6] != 191 and known(m.get_msgbuf())
    ]


def test_positions_and_attitudes_agree_with_pymavlink(replay: Replay) -> None:
    positions = [
        events.LocalPosition(m.time_boot_ms / 1000.0, (m.x, m.y, m.z), (m.vx, m.vy, m.vz))
        for m in replay.heard("LOCAL_POSITION_NED")
    ]
    assert len(positions) > 2600
    assert replay.of(events.LocalPosition) == positions
    attitudes, messages = replay.of(events.Attitude), replay.heard("ATTITUDE_QUATERNION")
    assert len(attitudes) == len(messages) in (3488, 0)  # ArduCopter was not asked for it
    for attitude, message in zip(attitudes, messages, strict=True):
        sent = (message.q1, message.q2, message.q3, message.q4)
        assert attitude.attitude == pytest.approx(sent, abs=1e-6)
        rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
        assert attitude.rates_frd_radps == rates


def test_modes_answers_and_texts_agree_with_pymavlink(replay: Replay) -> None:
    """pymavlink calls PX4's AUTO.LAND LAND. A text ends with a chunk of fewer than 50 bytes."""
    beats = replay.of(events.Heartbeat)
    assert [(beat.mode.rpartition(".")[2], beat.armed, beat.system_status) for beat in beats] == [
        (mavutil.mode_string_v10(m), bool(m.base_mode & 128), m.system_status)
        for m in replay.heard("HEARTBEAT")
    ]
    assert len({beat.mode for beat in beats}) > 2
    results = mavlink.enums["MAV_RESULT"]
    acks = replay.of(events.CommandAck)
    assert [(ack.command, f"MAV_RESULT_{ack.result}") for ack in acks] == [
        (m.command, results[m.result].name) for m in replay.heard("COMMAND_ACK")
    ]
    assert len({ack.result for ack in acks}) > 1
    begun, texts = "", []
    for message in replay.heard("STATUSTEXT"):
        begun += message.text
        if message.id == 0 or len(message.text) < 50:
            texts.append((message.severity, begun.rstrip("\t")))
            begun = ""
    assert [(event.severity, event.text) for event in replay.of(events.StatusText)] == texts
    assert len(texts) >= 10


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
def test_split_stream_gives_the_same_events(px4: Replay, portion: int) -> None:
    messages = px4.messages[:1500]
    data = b"".join(bytes(m.get_msgbuf()) for m in messages)
    whole, pieces = Session(SessionSettings()), Session(SessionSettings(stream=True))
    expected = [e for m in messages for e in whole.receive(bytes(m.get_msgbuf()), PEER, 0.0).events]
    found = []
    for at in range(0, len(data), portion):
        found += pieces.receive(data[at : at + portion], PEER, 0.0).events
    assert len(expected) > 200
    assert found == expected
    assert (pieces.splitter.frames, pieces.splitter.bytes_skipped) == (1500, 0)
