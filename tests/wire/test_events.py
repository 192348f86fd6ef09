"""What the session makes of messages: contents, time stamps and texts."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pymavlink.dialects.v20 import development
from vehicle_frames import ARDUPILOT, OFFBOARD, PEER, PX4, Sender, dropped, pinned

from offboard.mavlink import events
from offboard.mavlink.counters import DropReason
from offboard.mavlink.session import Session

NAN, INF = math.nan, math.inf
LEVEL = (1.0, 0.0, 0.0, 0.0)


def received(message: Any, autopilot: int = PX4) -> Any:
    """The event of a message of the vehicle."""
    vehicle = Sender()
    session = pinned(vehicle, autopilot)
    (event,) = session.receive(vehicle.frame(message), PEER, 0.0).events
    return event


# --- contents ---


@pytest.mark.parametrize(
    "frame",
    [
        lambda v: v.position(1000, NAN, 0, 0, 0, 0, 0),
        lambda v: v.position(1000, 0, INF, 0, 0, 0, 0),
        lambda v: v.position(1000, 0, 0, 1.1e5, 0, 0, 0),
        lambda v: v.position(1000, 0, 0, 0, -201.0, 0, 0),
        lambda v: v.position(1000, 0, 0, 0, 0, NAN, 0),
        lambda v: v.attitude(1000, 0, 0, 0, 0, 0, 0, 0),
        lambda v: v.attitude(1000, 2.0, 0, 0, 0, 0, 0, 0),
        lambda v: v.attitude(1000, NAN, 0, 0, 0, 0, 0, 0),
        lambda v: v.attitude(1000, *LEVEL, 0, NAN, 0),
        lambda v: v.attitude(1000, *LEVEL, 0, 0, 101.0),
        lambda v: v.frame(mavlink.MAVLink_param_value_message(b"X", NAN, 9, 1, 0)),
        lambda v: v.frame(mavlink.MAVLink_param_value_message(b"", 1.0, 9, 1, 0)),
        lambda v: v.frame(mavlink.MAVLink_param_value_message(b"X", 1.0, 77, 1, 0)),
    ],
)
def test_implausible_contents_are_dropped_but_logged(frame: Callable[[Sender], bytes]) -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    reception = session.receive(frame(vehicle), PEER, 0.0)
    assert (reception.events, len(reception.frames)) == ((), 1)
    assert dropped(session, DropReason.IMPLAUSIBLE) == 1


def test_modes() -> None:
    beat = mavlink.MAVLink_heartbeat_message(2, PX4, 128 | 1, OFFBOARD, 4, 3)
    assert received(beat) == events.Heartbeat("OFFBOARD", True, 4, 2)
    beat = mavlink.MAVLink_heartbeat_message(2, PX4, 1, 0x12345678, 3, 3)
    assert received(beat) == events.Heartbeat("UNKNOWN(0x12345678)", False, 3, 2)
    report = development.MAVLink_current_mode_message(0, 6 << 16, 3 << 16)
    assert received(report) == events.ModeReport("OFFBOARD")


def test_a_quaternion_nearly_unit_is_normalised() -> None:
    values = (0.84, 0.0, -0.63, 0.0, 0.1, 0.2, 0.3)  # length 1.05
    event = received(mavlink.MAVLink_attitude_quaternion_message(1500, *values))
    assert event.time_s == 1.5
    assert event.attitude == pytest.approx((0.8, 0.0, -0.6, 0.0))
    assert event.rates_frd_radps == pytest.approx((0.1, 0.2, 0.3))


def test_a_satellite_fix() -> None:
    fields = {"time_usec": 0, "lat": 473977435, "lon": 85455941, "alt": 489277, "eph": 70,
              "epv": 110, "vel": 300, "cog": 12000, "satellites_visible": 10}  # fmt: skip
    for fix_type, h_acc, expected in (
        (3, 900, events.GpsFix(pytest.approx(0.9))),
        (3, 0, events.GpsFix(None)),
        (2, 900, events.NoFix(2)),
    ):
        message = mavlink.MAVLink_gps_raw_int_message(**fields, fix_type=fix_type, h_acc=h_acc)
        assert received(message) == expected


def test_system_health() -> None:
    prearm, radio = 0x10000000, 0x10000
    for present, health, percent, expected in (
        (radio, prearm | radio, 87, (True, 0.87, True)),
        (radio, prearm, 100, (True, 1.0, False)),
        (0, ~prearm & 0xFFFFFFFF, -1, (False, None, False)),
    ):
        fields = (present, 0, health, 0, 15800, -1, percent, 0, 0, 0, 0, 0, 0)
        message = mavlink.MAVLink_sys_status_message(*fields)
        assert received(message) == events.SystemHealth(*expected)


def test_landed_acknowledgements_and_version() -> None:
    names = ("unknown", "on_ground", "in_air", "takeoff", "landing", *("unknown",) * 251)
    for number in (0, 1, 2, 3, 4, 99):
        message = mavlink.MAVLink_extended_sys_state_message(0, number)
        assert received(message) == events.Landed(names[number])
    results = {n: entry.name for n, entry in mavlink.enums["MAV_RESULT"].items()}
    for number in (*(n for n, name in results.items() if not name.endswith("ENUM_END")), 200):
        ack = mavlink.MAVLink_command_ack_message(21, number, 0, 0, 1, 191)
        name = results.get(number, "UNKNOWN(200)").removeprefix("MAV_RESULT_")
        assert received(ack) == events.CommandAck(21, name)
    fields = (0, 0, 0, *(bytes(8),) * 3, 0, 0, 77)
    for number, version in ((0x011001FF, (1, 16, 1, 255)), (0x040603FF, (4, 6, 3, 255))):
        message = mavlink.MAVLink_autopilot_version_message(0, number, *fields)
        assert received(message) == events.VehicleIdentity(77, events.FirmwareVersion(*version))


@pytest.mark.parametrize(
    "value", [0, 1, -1, 8, 2**31 - 1, -(2**31), -8388607, -4194305, 2139095041, 2143289343]
)
def test_px4_sends_integer_parameters_as_bytes(value: int) -> None:
    """The last four are signalling NaN as floats, which pymavlink changes: written as bytes."""
    vehicle = Sender()
    session = pinned(vehicle)
    frame = vehicle.frame(mavlink.MAVLink_param_value_message(b"COM_RC_IN_MODE", 0.0, 6, 1, 0))
    body = frame[1:10] + struct.pack("<i", value) + frame[14:-2]
    crc = mavlink.x25crc(body)
    crc.accumulate(bytes([mavlink.mavlink_map[22].crc_extra]))
    (event,) = session.receive(frame[:1] + body + struct.pack("<H", crc.crc), PEER, 1.0).events
    assert event.value == value  # type: ignore[union-attr]


def test_estimator_of_px4() -> None:
    """Flags and ratios of a recording of 1.16.1: before GPS, on the ground, in flight."""

    def report(flags: int, *ratios: float) -> Any:
        return received(mavlink.MAVLink_estimator_status_message(10**6, flags, *ratios, 0.3, 0.3))

    waiting = report(229, NAN, NAN, 0.02, NAN, 0.003, NAN)
    assert waiting.valid == {"attitude", "height"}
    assert waiting.problem == "its estimator has no valid horizontal velocity, horizontal position"
    for flags in (1023, 895, 831):
        good = report(flags, 0.04, 0.031, 0.018, 0.072, 0.001, NAN)
        assert good.problem == ""
        assert good.worst == ("heading", pytest.approx(0.072))
    bad = report(831, 1.3, 0.1, 0.1, 0.1, NAN, NAN)
    assert bad.problem == "its estimator rejects GPS velocity (innovation ratio 1.30, limit 1)"


def test_estimator_of_arducopter() -> None:
    """Flags of a recording of 4.6.3."""
    for flags, velocity, valid, worst in (
        (1024, 0.0, False, 0.03),
        (0, 0.0, False, 0.03),
        (167, 0.0, False, 0.03),
        (831, 0.0, True, 0.03),
        (831, 1.2, True, 1.2),
    ):
        ratios = (velocity, 0.01, 0.0, 0.03, 0.0, NAN)
        found = received(mavlink.MAVLink_ekf_status_report_message(flags, *ratios), ARDUPILOT)
        assert ("horizontal position" in found.valid) is valid
        assert found.worst[1] == pytest.approx(worst)


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
    """It has received a minute of the vehicle's time."""
    session = pinned(vehicle)
    times(session, vehicle.position(60000), vehicle.attitude(60000))
    session.poll(0.0)
    return session


def test_old_and_duplicate_messages_are_stale_per_message_id(
    session: Session, vehicle: Sender
) -> None:
    frames = [
        vehicle.position(65000),
        vehicle.attitude(64990),  # another message may lag
        vehicle.position(64990),
        vehicle.position(65000),
        vehicle.position(65010),
        vehicle.position(63010),  # two seconds late is still late
    ]
    assert times(session, *frames) == [65.0, 64.99, 65.01]
    assert dropped(session, DropReason.STALE) == 3


def test_a_jump_back_is_a_reboot(session: Session, vehicle: Sender) -> None:
    assert session.poll(0.0) == ()
    assert times(session, vehicle.position(500), vehicle.attitude(510)) == []
    reception = session.receive(vehicle.position(650), PEER, 0.0)
    assert reception.events[0] == events.Rebooted(0.65)
    assert isinstance(reception.events[1], events.LocalPosition)
    assert len(session.poll(0.0)) > 4  # the intervals are requested again
    assert times(session, vehicle.attitude(660), vehicle.position(660)) == [0.66, 0.66]
    assert session.poll(0.0) == ()


def test_stamps_that_are_late_far_ahead_or_stuck_are_dropped(
    session: Session, vehicle: Sender
) -> None:
    """However many come between those of the present. Several far ahead that follow each other are
    a clock that jumped."""
    late = vehicle.position(50000) + vehicle.attitude(50001) + vehicle.position(50010)
    assert session.receive(late, PEER, 0.0).events == ()
    for later_ms in range(10, 500, 10):
        frames = [
            vehicle.position(60000 + later_ms),
            vehicle.position(57000 + later_ms),
            vehicle.attitude(1060000 + 100 * later_ms),
            vehicle.attitude(60000),
        ]
        assert times(session, *frames) == [60.0 + later_ms / 1e3]
    assert dropped(session, DropReason.STALE) == 3 + 3 * 49
    jumped = [vehicle.position(2000000 + later_ms) for later_ms in range(0, 200, 60)]
    assert times(session, *jumped) == [2000.12, 2000.18]


WRAP_MS = 2**32


@pytest.mark.parametrize("turns", [0, 1])
def test_time_goes_on_where_the_32_bits_of_its_stamp_begin_again(turns: int) -> None:
    """First heard 30 ms before the wrap. The clock of TIMESYNC is 64 bits wide: it does not wrap,
    and its replies stay comparable with the stamps, also on a vehicle that has run for 50 days."""
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
    times(session, vehicle.position(60_000))
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


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 0, 2), (0, 1, 1, 0, 2)])
def test_chunks_are_joined_in_any_order(
    order: tuple[int, ...], session: Session, vehicle: Sender
) -> None:
    """Also where the chunks of two texts alternate."""
    frames = [vehicle.text(CHUNKS[i], text_id, i) for i in order for text_id in (8, 9)]
    assert texts(session, *frames[:-2]) == []
    assert texts(session, *frames[-2:]) == [LONG.decode()] * 2


def test_a_missing_chunk_is_marked_after_a_second(session: Session, vehicle: Sender) -> None:
    first, last = vehicle.text(CHUNKS[0], 3, 0), vehicle.text(CHUNKS[2], 3, 2)
    assert texts(session, first, last) == []
    assert texts(session, vehicle.text(b"other"), now_s=0.9) == ["other"]
    mark = CHUNKS[0].decode() + "[...]" + CHUNKS[2].decode().strip()
    assert texts(session, vehicle.text(b"other"), now_s=1.1) == [mark, "other"]


def test_the_number_of_incomplete_texts_is_limited(session: Session, vehicle: Sender) -> None:
    frames = [vehicle.text(b"x" * 50, text_id, 0) for text_id in range(1, 101)]
    assert len(texts(session, *frames)) == 92
    assert texts(session, vehicle.text(b"x" * 50, 500, 200)) == []


def test_texts_are_printable(session: Session, vehicle: Sender) -> None:
    for data, text in (
        (b"Takeoff detected\t", "Takeoff detected"),
        (b"x" * 50, "x" * 50),  # id 0: complete in itself
        (b"\x1b[31mred\x07", "[31mred"),  # no control sequences reach a terminal
        (b"\xff\xfe", "\ufffd\ufffd"),
        ("3 \u00b0 tilt".encode(), "3 \u00b0 tilt"),
    ):
        assert texts(session, vehicle.text(data)) == [text]
