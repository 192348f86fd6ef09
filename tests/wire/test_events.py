"""The session's events: contents of messages, time stamps and texts."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pymavlink.dialects.v20 import development
from vehicle_frames import ARDUPILOT, PEER, PX4, Sender, framed, pinned

from offboard.mavlink import events
from offboard.mavlink.session import Session

NAN, INF = math.nan, math.inf


def received(message: Any, autopilot: int = PX4) -> Any:
    """The event of a message of the vehicle, which must be the same in a frame of MAVLink 1.
    Another frame follows in the same datagram."""
    found = []
    for version_1 in (False, True)[: 1 + (message.id < 256)]:
        vehicle = Sender(7)
        session, frame = pinned(vehicle, autopilot), vehicle.frame(message, version_1)
        reception = session.receive(frame + vehicle.text(b"behind"), PEER, 0.0)
        assert reception.frames[0] == frame
        event, _ = reception.events
        found.append(event)
    assert found[-1] == found[0]
    return found[0]


# --- contents ---


def test_implausible_contents_are_dropped_but_logged() -> None:
    """Each field of position, velocity, attitude and rates is wrong in turn. Quaternions of zero
    and double length are wrong, too."""
    vehicle = Sender()
    session = pinned(vehicle)
    frames = [vehicle.attitude(1000, *(0.0,) * 7)]
    for state, good, limits in (
        (vehicle.position, (0.0,) * 6, (1.1e5,) * 3 + (201.0,) * 3),
        (vehicle.attitude, (1.0, *(0.0,) * 6), (2.0,) * 4 + (101.0,) * 3),
    ):
        for place, limit in enumerate(limits):
            for bad in (NAN, INF, limit, -limit):
                frames.append(state(1000, *good[:place], bad, *good[place + 1 :]))
    for value, kind in ((NAN, 9), (1.0, 77)):
        parameter = mavlink.MAVLink_param_value_message(b"COM_OF_LOSS_T", value, kind, 1, 0)
        frames.append(vehicle.frame(parameter))
    for frame in frames:
        reception = session.receive(frame, PEER, 0.0)
        assert (reception.events, reception.frames) == ([], [frame])


FIX = {"time_usec": 0, "lat": 473977435, "lon": 85455941, "alt": 489277, "eph": 70, "epv": 110,
       "vel": 300, "cog": 12000, "satellites_visible": 10}  # fmt: skip
PREARM, RADIO = 0x10000000, 0x10000


def status(present: int, health: int, percent: int, enabled: int = 0) -> Any:
    fields = (present, enabled, health, 0, 15800, -1, percent, *(0,) * 6)
    return mavlink.MAVLink_sys_status_message(*fields)


def version(number: int) -> Any:
    fields = (0, number, 0, 0, 0, *(bytes(8),) * 3, 0, 0, 77)
    return mavlink.MAVLink_autopilot_version_message(*fields)


@pytest.mark.parametrize(
    ("message", "event"),
    [
        (
            mavlink.MAVLink_heartbeat_message(2, PX4, 1, 0x12345678, 3, 3),
            events.Heartbeat("UNKNOWN(0x12345678)", False, 3, 2),
        ),
        (
            development.MAVLink_current_mode_message(0, 6 << 16, 3 << 16),
            events.ModeReport("OFFBOARD"),
        ),
        (mavlink.MAVLink_gps_raw_int_message(**FIX, fix_type=3), events.GpsFix()),
        (mavlink.MAVLink_gps_raw_int_message(**FIX, fix_type=2), events.NoFix(2)),
        (status(RADIO, PREARM | RADIO, 87), events.SystemHealth(True, 0.87, True)),
        (status(RADIO, PREARM, 100), events.SystemHealth(True, 1.0, False)),
        (status(PREARM, 0, -1, PREARM), events.SystemHealth(False, None, False)),
        (status(PREARM, 0, -1), events.SystemHealth(True, None, False)),  # ARMING_CHECK 0
        (status(0, ~PREARM & 0xFFFFFFFF, -1), events.SystemHealth(False, None, False)),
        (mavlink.MAVLink_extended_sys_state_message(0, 3), events.Landed("takeoff")),
        (mavlink.MAVLink_extended_sys_state_message(0, 4), events.Landed("landing")),
        (mavlink.MAVLink_extended_sys_state_message(0, 99), events.Landed("unknown")),
        # a quaternion of length 1.05 is normalised
        (
            mavlink.MAVLink_attitude_quaternion_message(1500, 0.84, 0, -0.63, 0, 0.1, 0.2, 0.3),
            events.Attitude(
                1.5, pytest.approx((0.8, 0.0, -0.6, 0.0)), pytest.approx((0.1, 0.2, 0.3))
            ),
        ),
        (version(0x011001FF), events.VehicleIdentity(77, events.FirmwareVersion(1, 16, 1, 255))),
    ],
)
def test_messages_are_decoded_to_events(message: Any, event: events.Event) -> None:
    assert received(message) == event


@pytest.mark.parametrize("value", [-1, 2**31 - 1, -(2**31), -8388607, 2139095041])
def test_px4_sends_integer_parameters_as_bytes(value: int) -> None:
    """The payload is packed here: pymavlink would change the last two, as floats signalling NaN."""
    session = pinned(Sender())
    payload = struct.pack("<iHH16sB", value, 1, 0, b"COM_RC_IN_MODE", 6)
    (event,) = session.receive(framed(22, payload), PEER, 1.0).events
    assert event.value == value  # type: ignore[union-attr]


def test_estimator_reports_name_their_problem() -> None:
    """Flags were recorded from PX4 1.16.1 and ArduCopter 4.6.3, before the fix and in flight."""
    waiting, flying, wrong = (0.0, NAN, 0.02, NAN, 0.003), (0.04, 0.03, 0.02, 0.07), (1.3, 0.1)
    unfixed = "no valid horizontal velocity, horizontal position"
    for flags, ratios, accuracy_m, problem in (
        (229, waiting, NAN, unfixed),
        (831, flying, 0.3, ""),
        (831, wrong, 0.3, "rejects velocity (innovation ratio 1.30, limit 1)"),
    ):
        filled = (*ratios, *(NAN,) * (6 - len(ratios)))
        px4 = mavlink.MAVLink_estimator_status_message(10**6, flags, *filled, accuracy_m, 0.3)
        copter = mavlink.MAVLink_ekf_status_report_message(flags, *filled[:5], NAN)
        for message, autopilot in ((px4, PX4), (copter, ARDUPILOT)):
            report = received(message, autopilot)
            assert report.problem.endswith(problem)
            assert bool(report.problem) is bool(problem)
            assert report.worst[1] == pytest.approx(max(r for r in ratios if r == r))
        known_m = None if math.isnan(accuracy_m) else pytest.approx(accuracy_m)
        assert received(px4).accuracy_m == known_m
    # of PX4 1.16.1 by GPS, by external vision, and after that was lost
    for flags, by_gps in ((831, True), (0x16F, False), (0x6F, False)):
        px4 = mavlink.MAVLink_estimator_status_message(10**6, flags, *filled, 0.3, 0.3)
        assert received(px4).by_gps == by_gps


# --- time ---


def times(session: Session, *frames: bytes) -> list[float]:
    found = []
    for frame in frames:
        for event in session.receive(frame, PEER, 0.0).events:
            assert isinstance(event, events.LocalPosition | events.Attitude)
            found.append(event.time_s)
    return found


@pytest.fixture
def vehicle() -> Sender:
    return Sender()


@pytest.fixture
def session(vehicle: Sender) -> Session:
    """A session that has received telemetry stamped 60 s."""
    session = pinned(vehicle)
    times(session, vehicle.position(60000), vehicle.attitude(60000))
    session.poll(0.0)
    return session


def test_backward_time_jump_is_a_reboot(session: Session, vehicle: Sender) -> None:
    """After a reboot the message intervals are requested again."""
    assert times(session, vehicle.position(500), vehicle.attitude(510)) == []
    assert session.poll(0.0) == ()
    reboot, position = session.receive(vehicle.position(650), PEER, 0.0).events
    assert reboot == events.Rebooted()
    assert isinstance(position, events.LocalPosition)
    assert len(session.poll(0.0)) > 4
    assert times(session, vehicle.attitude(660), vehicle.position(660)) == [0.66, 0.66]


def test_late_future_and_stuck_stamps_are_dropped(session: Session, vehicle: Sender) -> None:
    """Stamps are compared with those of the same message, however many wrong ones come between.
    Several far ahead that follow each other are a clock that jumped."""
    late = vehicle.position(50000) + vehicle.attitude(50001) + vehicle.position(50010)
    assert session.receive(late, PEER, 0.0).events == []
    for later_ms in range(10, 500, 10):
        frames = [
            vehicle.position(60000 + later_ms),
            vehicle.position(57000 + later_ms),
            vehicle.attitude(1060000 + 100 * later_ms),
            vehicle.attitude(60000),
        ]
        assert times(session, *frames) == [60.0 + later_ms / 1e3]
    assert times(session, vehicle.attitude(60480), vehicle.position(60490)) == [60.48]
    jumped = [vehicle.position(2000000 + later_ms) for later_ms in range(0, 200, 60)]
    assert times(session, *jumped) == [2000.12, 2000.18]


WRAP_MS = 2**32


@pytest.mark.parametrize("turns", [0, 1])
def test_time_continues_when_time_boot_ms_wraps(turns: int) -> None:
    """The vehicle is first heard 30 ms before the wrap. TIMESYNC has 64 bits and does not wrap; its
    replies stay comparable with the stamps, also on a vehicle that has run for 50 days."""
    vehicle = Sender()
    session = pinned(vehicle)
    before = [vehicle.position(WRAP_MS - 30), vehicle.attitude(WRAP_MS - 20)]
    after = [
        vehicle.position(10),
        vehicle.attitude(WRAP_MS - 10),  # late, from before the wrap
        vehicle.attitude(15),
        vehicle.position(5),  # older than the one before
        vehicle.position(20),
    ]
    expected_ms = [-30, -20, 10, -10, 15, 20]
    expected_s = [pytest.approx((WRAP_MS + each) / 1e3, abs=1e-6) for each in expected_ms]
    assert times(session, *before, *after) == expected_s
    arrived_ms = turns * WRAP_MS + WRAP_MS + 45
    reply = vehicle.frame(mavlink.MAVLink_timesync_message(arrived_ms * 10**6, 77))
    (answer,) = session.receive(reply, PEER, 0.0).events
    assert answer == events.TimesyncReply(77, (WRAP_MS + 45) * 10**6)
    times(session, *map(vehicle.position, (60_000, 60_060, 60_120)))  # after an outage
    assert times(session, vehicle.position(500), vehicle.position(510)) == []
    assert isinstance(session.receive(vehicle.position(650), PEER, 0.0).events[0], events.Rebooted)


# --- STATUSTEXT ---

LONG = b"Preflight Fail: " + bytes(range(65, 91)) * 4  # 120 bytes: chunks of 50, 50 and 20
CHUNKS = (LONG[:50], LONG[50:100], LONG[100:] + b"\t")


def texts(session: Session, *frames: bytes, now_s: float = 0.0) -> list[str]:
    return [
        event.text
        for frame in frames
        for event in session.receive(frame, PEER, now_s).events
        if isinstance(event, events.StatusText)
    ]


@pytest.mark.parametrize("order", [(2, 0, 1), (0, 1, 1, 0, 2)])
def test_text_chunks_are_joined_in_any_order(
    order: tuple[int, ...], session: Session, vehicle: Sender
) -> None:
    """The chunks of two texts may alternate."""
    frames = [vehicle.text(CHUNKS[i], text_id, i) for i in order for text_id in (8, 9)]
    assert texts(session, *frames[:-2]) == []
    assert texts(session, *frames[-2:]) == [LONG.decode()] * 2


def test_missing_text_chunk_is_marked_after_a_second(session: Session, vehicle: Sender) -> None:
    first, last = vehicle.text(CHUNKS[0], 3, 0), vehicle.text(CHUNKS[2], 3, 2)
    assert texts(session, first, last) == []
    assert texts(session, vehicle.text(b"other"), now_s=0.9) == ["other"]
    mark = CHUNKS[0].decode() + "[...]" + CHUNKS[2].decode().strip()
    assert texts(session, vehicle.text(b"other"), now_s=1.1) == [mark, "other"]
    frames = [vehicle.text(b"x" * 50, text_id, 0) for text_id in range(1, 101)]
    assert len(texts(session, *frames, now_s=1.1)) == 92
    assert texts(session, vehicle.text(b"x" * 50, 500, 200), now_s=1.1) == []


def test_texts_are_printable(session: Session, vehicle: Sender) -> None:
    for data, text in (
        (b"x" * 50, "x" * 50),  # id 0: a text of one chunk
        (b"\x1b[31mred\x07", "[31mred"),  # no control sequences reach a terminal
        (b"\xff\xfe", "\ufffd\ufffd"),
        ("3 \u00b0 tilt".encode(), "3 \u00b0 tilt"),
    ):
        assert texts(session, vehicle.text(data)) == [text]
