"""The session: which sender is the vehicle, what is dropped and why, what is sent."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pymavlink.dialects.v20 import development
from vehicle_frames import ARDUPILOT, OFFBOARD, PEER, PX4, Sender, pinned, understood

from offboard.mavlink import events
from offboard.mavlink.counters import DropReason
from offboard.mavlink.outgoing import CommandLong, Heartbeat, Outgoing, Timesync
from offboard.mavlink.session import Session, SessionSettings

STRANGER = ("10.0.0.9", 4000)
Triple = tuple[float, float, float]


def dropped(session: Session, reason: DropReason) -> int:
    return session.counters.dropped[reason]


# --- pinning ---


def test_the_first_autopilot_heard_is_the_vehicle() -> None:
    session = Session(SessionSettings())
    reception = session.receive(Sender(42).heartbeat(), PEER, 0.0)
    assert reception.events == (
        events.VehicleFound(42, 1, "px4"),
        events.Heartbeat("OFFBOARD", False, 3, 2),
    )
    assert session.dialect is not None
    assert session.dialect.name == "px4"
    assert session.encode(Heartbeat(18))[5:7] == bytes([42, 191])


@pytest.mark.parametrize(
    ("sender", "autopilot", "vehicle_type", "reason"),
    [
        (Sender(255, 190), 8, 6, DropReason.FOREIGN_COMPONENT),
        (Sender(255, 1), 8, 6, DropReason.NO_VEHICLE),
        (Sender(255, 1), PX4, 6, DropReason.NO_VEHICLE),
        (Sender(1, 154), 8, 26, DropReason.FOREIGN_COMPONENT),
        (Sender(1, 1), 0, 2, DropReason.UNSUPPORTED_AUTOPILOT),
    ],
    ids=["ground station", "on component 1", "claiming PX4", "gimbal", "generic autopilot"],
)
def test_others_do_not_pin(
    sender: Sender, autopilot: int, vehicle_type: int, reason: DropReason
) -> None:
    session = Session(SessionSettings())
    frame = sender.heartbeat(autopilot, vehicle_type=vehicle_type)
    reception = session.receive(frame, PEER, 0.0)
    assert reception.events == ()
    assert reception.frames == (frame,)
    assert session.vehicle is None
    assert dropped(session, reason) == 1


def test_telemetry_before_the_first_heartbeat_is_dropped() -> None:
    session = Session(SessionSettings())
    reception = session.receive(Sender().position(1000), PEER, 0.0)
    assert (reception.events, len(reception.frames)) == ((), 1)
    assert dropped(session, DropReason.NO_VEHICLE) == 1


def test_others_are_dropped_once_pinned() -> None:
    vehicle = Sender(1)
    session = pinned(vehicle)
    assert session.receive(vehicle.position(1000), STRANGER, 0.0).frames == ()
    assert dropped(session, DropReason.FOREIGN_PEER) == 1
    assert session.receive(Sender(2).position(1000), PEER, 0.0).events == ()
    assert dropped(session, DropReason.FOREIGN_SYSTEM) == 1
    assert session.receive(Sender(1, 154).position(1000), PEER, 0.0).events == ()
    assert dropped(session, DropReason.FOREIGN_COMPONENT) == 1
    assert len(session.receive(vehicle.position(1000), PEER, 0.0).events) == 1


RESTARTED = (PEER[0], 50123)


def test_the_vehicle_may_move_to_another_port_after_a_silence() -> None:
    vehicle = Sender(1)
    session = pinned(vehicle)
    session.receive(vehicle.position(1000), PEER, 10.0)
    assert session.receive(vehicle.position(1020), RESTARTED, 10.5).events == ()
    assert dropped(session, DropReason.FOREIGN_PEER) == 1
    reception = session.receive(vehicle.position(1040), RESTARTED, 10.51)
    moved, position = reception.events
    assert moved == events.PeerChanged(RESTARTED)
    assert isinstance(position, events.LocalPosition)
    assert Heartbeat(18) in session.poll(10.51)  # at once, 0.51 s after the last one
    assert session.receive(vehicle.position(1060), PEER, 10.53).events == ()  # the old one is back


@pytest.mark.parametrize(
    ("sender", "place", "silence_s"),
    [
        (Sender(1), RESTARTED, 0.5),
        (Sender(1), STRANGER, 60.0),
        (Sender(2), RESTARTED, 60.0),
        (Sender(1, 154), RESTARTED, 60.0),
    ],
    ids=["beside the vehicle", "from another host", "another vehicle", "another component"],
)
def test_no_other_sender_replaces_the_vehicle(
    sender: Sender, place: tuple[str, int], silence_s: float
) -> None:
    vehicle = Sender(1)
    session = pinned(vehicle)
    session.receive(vehicle.position(1000), PEER, 10.0)
    assert session.receive(sender.position(1020), place, 10.0 + silence_s).events == ()
    assert session.receive(b"\xfd nonsense", place, 10.0 + silence_s).events == ()
    assert dropped(session, DropReason.FOREIGN_PEER) == 2
    assert len(session.receive(vehicle.position(1040), PEER, 99.0).events) == 1


def test_our_own_frames_are_ignored_and_not_logged() -> None:
    session = pinned(Sender())
    reception = session.receive(session.encode(Heartbeat(18)), PEER, 0.0)
    assert (reception.frames, reception.events) == ((), ())
    assert dropped(session, DropReason.ECHO) == 1


def test_another_program_with_our_ids_and_a_strange_setpoint_are_seen() -> None:
    """Another companion that uses our ids, and one that sends setpoints as another component. A
    controller is who sends setpoints or commands a mode, from the vehicle's own system; a request
    for a parameter or a rate is none."""
    session = pinned(Sender())
    twin, other = Sender(1, 191), Sender(1, 195)
    assert session.receive(twin.heartbeat(8, 7, vehicle_type=18), PEER, 0.0).events == (
        events.OtherCompanion(1, 191, 7),
    )
    land, rate = (mavlink.MAVLink_command_long_message(1, 1, n, 0, *[0] * 7) for n in (21, 511))
    for sender in (twin, other):
        assert session.receive(sender.frame(land), PEER, 0.0).events[:1] == (
            events.OtherSender(*sender.ids, 76),
        )
        assert session.receive(sender.frame(rate), PEER, 0.0).events == ()
    read = mavlink.MAVLink_param_request_read_message(1, 1, b"MPC_THR_HOVER", -1)
    assert session.receive(twin.frame(read), PEER, 0.0).events == ()
    assert session.receive(Sender(255, 190).frame(land), PEER, 0.0).events == ()  # the pilot's
    assert dropped(session, DropReason.SAME_IDS) == 4
    level = mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 7, [1, 0, 0, 0], 0, 0, 0, 0.5)
    assert session.receive(other.frame(level), PEER, 0.0).events == (
        events.OtherSender(1, 195, 82),
    )
    assert session.receive(other.heartbeat(8, 0, vehicle_type=18), PEER, 0.0).events == (
        events.OtherCompanion(1, 195, 0),
    )


@pytest.mark.parametrize(("target", "seen"), [(0, True), (1, True), (2, False)])
@pytest.mark.parametrize("name", ["attitude", "local", "global"])
def test_a_setpoint_for_another_vehicle_on_the_link_is_not_ours(
    name: str, target: int, seen: bool
) -> None:
    session = pinned(Sender())
    zeros = (0,) * 12
    setpoint = {
        "attitude": mavlink.MAVLink_set_attitude_target_message(
            0, target, 1, 7, [1, 0, 0, 0], 0, 0, 0, 0.5
        ),
        "local": mavlink.MAVLink_set_position_target_local_ned_message(0, target, 1, 1, *zeros),
        "global": mavlink.MAVLink_set_position_target_global_int_message(0, target, 1, 5, *zeros),
    }[name]
    received = session.receive(Sender(255, 190).frame(setpoint), PEER, 0.0).events
    assert bool(received) is seen


def test_current_mode_reports_the_mode() -> None:
    session = pinned(Sender())
    message = development.MAVLink_current_mode_message(0, 6 << 16, 3 << 16)
    frame = Sender().frame(message)
    assert session.receive(frame, PEER, 0.0).events == (events.ModeReport("OFFBOARD"),)


MODES = ("MANUAL", "ALTCTL", "POSCTL", "ACRO", "OFFBOARD", "STABILIZED")
MAIN_MODES = (1, 2, 3, 5, 6, 7)  # of PX4, in the same order


def accepted_modes(arrivals: list[tuple[float, int, bytes]], session: Session) -> list[int]:
    """Numbers of the reports of the mode that count, of frames (time of arrival, number, bytes)."""
    accepted = []
    for now_s, number, frame in sorted(arrivals):
        for event in session.receive(frame, PEER, now_s).events:
            if isinstance(event, events.Heartbeat):
                assert event.mode == MODES[number % 6]
                accepted.append(number)
    return accepted


def mode_reports(
    rng: np.random.Generator, rate_hz: float, vehicle: Sender
) -> list[tuple[float, int, bytes]]:
    """20 s of frames at `rate_hz`, a HEARTBEAT with the next mode each second: when it is sent, its
    number (-1: another message), bytes."""
    frames, reports = [], 0
    for k in range(int(20 * rate_hz)):
        sent_s = 1.0 + k / rate_hz
        if sent_s >= 1.0 + reports + rng.uniform(0.0, 0.2):
            mode = MAIN_MODES[reports % 6] << 16
            frames.append((sent_s, reports, vehicle.heartbeat(custom_mode=mode)))
            reports += 1
        else:
            frames.append((sent_s, -1, vehicle.position(round(1e3 * sent_s))))
    return frames


@pytest.mark.parametrize("seed", range(20))
def test_a_report_of_the_mode_that_a_newer_one_has_overtaken_is_dropped(seed: int) -> None:
    """However late it is, up to 127 frames and 1.2 s; those in order count. 5 % are lost."""
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


@pytest.mark.parametrize("seed", range(20))
def test_every_report_of_the_mode_counts_after_outages_and_restarts(seed: int) -> None:
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
    rebooted = Sender(1)  # counts from 0 again
    beat = rebooted.heartbeat(custom_mode=2 << 16)
    (event, *_) = session.receive(beat, PEER, arrivals[-1][0] + 1.0).events
    assert isinstance(event, events.Heartbeat)


@pytest.mark.parametrize(
    ("ids", "vehicle_type", "autopilot", "seen"),
    [
        ((1, 192), 18, 8, True),
        ((7, 191), 18, 8, True),
        ((1, 192), 6, 8, True),  # as a companion of PX4 calls itself
        ((255, 190), 6, 8, False),
        ((1, 154), 26, 8, False),
        ((2, 1), 2, PX4, False),
    ],
)
def test_another_companion_computer_is_seen(
    ids: tuple[int, int], vehicle_type: int, autopilot: int, seen: bool
) -> None:
    session = pinned(Sender(1))
    beat = Sender(*ids).heartbeat(autopilot, vehicle_type=vehicle_type)
    expected = (events.OtherCompanion(*ids, 0x00060000),) if seen else ()
    assert session.receive(beat, PEER, 1.0).events == expected


def test_acks_for_others_are_not_ours() -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    for system_id, component_id in ((255, 190), (1, 190)):
        frame = vehicle.ack(400, 0, system_id, component_id)
        assert session.receive(frame, PEER, 0.0).events == ()
    assert dropped(session, DropReason.NOT_FOR_US) == 2
    for address in ((1, 191), (0, 0)):
        reception = session.receive(vehicle.ack(400, 0, *address), PEER, 0.0)
        assert reception.events == (events.CommandAck(400, "ACCEPTED"),)


@pytest.mark.parametrize(
    ("number", "name"),
    [
        *(
            (number, entry.name.removeprefix("MAV_RESULT_"))
            for number, entry in mavlink.enums["MAV_RESULT"].items()
            if not entry.name.endswith("ENUM_END")
        ),
        (200, "UNKNOWN(200)"),
    ],
)
def test_ack_results_have_the_names_of_the_specification(number: int, name: str) -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    reception = session.receive(vehicle.ack(21, number), PEER, 0.0)
    assert reception.events == (events.CommandAck(21, name),)


# --- contents ---

NAN, INF = math.nan, math.inf
LEVEL = (1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    "frame",
    [
        lambda v: v.position(1000, NAN, 0, 0, 0, 0, 0),
        lambda v: v.position(1000, 0, INF, 0, 0, 0, 0),
        lambda v: v.position(1000, 0, 0, 1.1e5, 0, 0, 0),
        lambda v: v.position(1000, 0, 0, 0, -201.0, 0, 0),
        lambda v: v.position(1000, 0, 0, 0, 0, NAN, 0),
        lambda v: v.position(1000, 0, 0, 0, 0, 0, -INF),
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


def test_a_satellite_fix() -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    fields = {"time_usec": 0, "lat": 473977435, "lon": 85455941, "alt": 489277, "eph": 70,
              "epv": 110, "vel": 300, "cog": 12000, "satellites_visible": 10}  # fmt: skip
    for fix_type, h_acc, expected in (
        (3, 900, events.GpsFix(pytest.approx(0.9))),
        (3, 0, events.GpsFix(None)),
        (2, 900, events.NoFix(2)),
    ):
        fix = mavlink.MAVLink_gps_raw_int_message(**fields, fix_type=fix_type, h_acc=h_acc)
        assert session.receive(vehicle.frame(fix), PEER, 0.0).events == (expected,)


def test_a_quaternion_nearly_unit_is_normalised() -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    frame = vehicle.attitude(1500, 0.84, 0.0, -0.63, 0.0, 0.1, 0.2, 0.3)  # length 1.05
    (event,) = session.receive(frame, PEER, 0.0).events
    assert isinstance(event, events.Attitude)
    assert event.time_s == 1.5
    assert event.attitude == pytest.approx((0.8, 0.0, -0.6, 0.0))
    assert event.rates_frd_radps == pytest.approx((0.1, 0.2, 0.3))


@pytest.mark.parametrize(
    ("health", "millivolts", "percent", "expected"),
    [
        (0x10000000, 15800, 87, events.SystemHealth(True, pytest.approx(15.8), 0.87)),
        (0x0FFFFFFF, 65535, -1, events.SystemHealth(False, None, None)),
    ],
)
def test_system_health(
    health: int, millivolts: int, percent: int, expected: events.SystemHealth
) -> None:
    vehicle = Sender()
    frame = vehicle.frame(
        mavlink.MAVLink_sys_status_message(
            0, 0, health, 0, millivolts, -1, percent, 0, 0, 0, 0, 0, 0
        )
    )
    assert pinned(vehicle).receive(frame, PEER, 0.0).events == (expected,)


@pytest.mark.parametrize(
    ("number", "state"),
    [
        (0, "unknown"),
        (1, "on_ground"),
        (2, "in_air"),
        (3, "takeoff"),
        (4, "landing"),
        (99, "unknown"),
    ],
)
def test_landed(number: int, state: str) -> None:
    vehicle = Sender()
    frame = vehicle.frame(mavlink.MAVLink_extended_sys_state_message(0, number))
    assert pinned(vehicle).receive(frame, PEER, 0.0).events == (events.Landed(state),)


def test_name_of_an_unknown_mode() -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    reception = session.receive(vehicle.heartbeat(custom_mode=0x12345678), PEER, 0.0)
    assert reception.events == (events.Heartbeat("UNKNOWN(0x12345678)", False, 3, 2),)


# --- time ---


def times(session: Session, *frames: bytes) -> list[float]:
    found = []
    for frame in frames:
        for event in session.receive(frame, PEER, 0.0).events:
            assert isinstance(event, events.LocalPosition | events.Attitude)
            found.append(event.time_s)
    return found


def test_old_and_duplicate_messages_are_stale_per_message_id() -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    frames = [
        vehicle.position(5000),
        vehicle.attitude(4990),  # another message may lag
        vehicle.position(4990),
        vehicle.position(5000),
        vehicle.position(5010),
        vehicle.position(3010),  # two seconds late is still late
    ]
    assert times(session, *frames) == [5.0, 4.99, 5.01]
    assert dropped(session, DropReason.STALE) == 3


def test_a_jump_back_is_a_reboot() -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    times(session, vehicle.position(60000), vehicle.attitude(60000))
    assert session.poll(0.0) == ()
    assert times(session, vehicle.position(500), vehicle.attitude(510)) == []
    reception = session.receive(vehicle.position(650), PEER, 0.0)
    assert reception.events[0] == events.Rebooted(0.65)
    assert isinstance(reception.events[1], events.LocalPosition)
    assert len(session.poll(0.0)) > 4  # the intervals are requested again
    assert times(session, vehicle.attitude(660), vehicle.position(660)) == [0.66, 0.66]
    assert session.poll(0.0) == ()


def test_a_stamp_that_is_late_is_dropped() -> None:
    """However late: neither one datagram, nor several between those of the present."""
    vehicle = Sender()
    session = pinned(vehicle)
    times(session, vehicle.position(60000), vehicle.attitude(60000))
    late = vehicle.position(50000) + vehicle.attitude(50001) + vehicle.position(50010)
    assert session.receive(late, PEER, 0.0).events == ()
    for later_ms in range(10, 500, 10):
        frames = [vehicle.position(60000 + later_ms), vehicle.position(57000 + later_ms)]
        assert times(session, *frames) == [60.0 + later_ms / 1e3]
    assert dropped(session, DropReason.STALE) == 3 + 49


def test_a_stamp_that_is_far_ahead_is_dropped_until_others_follow_it() -> None:
    """One would make those of the present a reboot; several are a clock that jumped."""
    vehicle = Sender()
    session = pinned(vehicle)
    times(session, vehicle.position(60000), vehicle.attitude(60000))
    for later_ms in range(10, 500, 10):
        frames = [vehicle.position(60000 + later_ms), vehicle.attitude(1060000 + 100 * later_ms)]
        assert times(session, *frames) == [60.0 + later_ms / 1e3]
    assert dropped(session, DropReason.STALE) == 49
    jumped = [vehicle.position(2000000 + later_ms) for later_ms in range(0, 200, 60)]
    assert times(session, *jumped) == [2000.12, 2000.18]


def test_a_message_that_repeats_its_stamp_for_long_is_stale() -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    times(session, vehicle.attitude(60000))
    for later_ms in range(60010, 65000, 10):
        assert times(session, vehicle.position(later_ms), vehicle.attitude(60000)) == [
            later_ms / 1e3
        ]


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
    assert dropped(session, DropReason.STALE) == 1
    arrived_ms = turns * WRAP_MS + WRAP_MS + 45
    reply = vehicle.frame(mavlink.MAVLink_timesync_message(arrived_ms * 10**6, 77))
    (answer,) = session.receive(reply, PEER, 0.0).events
    assert answer == events.TimesyncReply(77, (WRAP_MS + 45) * 10**6)


def test_a_reboot_after_the_wrap_is_a_reboot() -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    times(session, vehicle.position(WRAP_MS - 10), vehicle.position(60_000))
    assert times(session, vehicle.position(500), vehicle.position(510)) == []
    reception = session.receive(vehicle.position(650), PEER, 0.0)
    assert isinstance(reception.events[0], events.Rebooted)
    assert len(session.receive(vehicle.position(660), PEER, 0.0).events) == 1


# --- STATUSTEXT ---


def texts(session: Session, *frames: bytes, now_s: float = 0.0) -> list[str]:
    return [
        event.text
        for frame in frames
        for event in session.receive(frame, PEER, now_s).events
        if isinstance(event, events.StatusText)
    ]


LONG = b"Preflight Fail: " + bytes(range(65, 91)) * 4  # 120 bytes: chunks of 50, 50 and 20
CHUNKS = (LONG[:50], LONG[50:100], LONG[100:] + b"\t")


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 0, 2), (0, 1, 1, 0, 2)])
def test_chunks_are_joined_in_any_order(order: tuple[int, ...]) -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    frames = [vehicle.text(CHUNKS[i], 9, i) for i in order]
    assert texts(session, *frames[:-1]) == []
    assert texts(session, frames[-1]) == [LONG.decode()]


def test_two_texts_interleaved() -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    frames = [
        vehicle.text(b"a" * 50, 1, 0),
        vehicle.text(b"b" * 50, 2, 0),
        vehicle.text(b"B", 2, 1),
        vehicle.text(b"A", 1, 1),
    ]
    assert texts(session, *frames) == ["b" * 50 + "B", "a" * 50 + "A"]


def test_a_missing_chunk_is_marked_after_a_second() -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    first, last = vehicle.text(CHUNKS[0], 3, 0), vehicle.text(CHUNKS[2], 3, 2)
    assert texts(session, first, last) == []
    other = vehicle.text(b"other")
    assert texts(session, other, now_s=0.9) == ["other"]
    mark = CHUNKS[0].decode() + "[...]" + CHUNKS[2].decode().strip()
    assert texts(session, vehicle.text(b"other"), now_s=1.1) == [mark, "other"]


def test_the_number_of_incomplete_texts_is_limited() -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    frames = [vehicle.text(b"x" * 50, text_id, 0) for text_id in range(1, 101)]
    assert len(texts(session, *frames)) == 92
    assert texts(session, vehicle.text(b"x" * 50, 500, 200)) == []


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"Takeoff detected\t", "Takeoff detected"),
        (b"x" * 50, "x" * 50),  # id 0: complete in itself
        (b"\x1b[31mred\x07", "[31mred"),  # no control sequences reach a terminal
        (b"\xff\xfe", "\ufffd\ufffd"),
        ("3 \u00b0 tilt".encode(), "3 \u00b0 tilt"),
    ],
)
def test_texts_are_printable(data: bytes, text: str) -> None:
    vehicle = Sender()
    assert texts(pinned(vehicle), vehicle.text(data)) == [text]


# --- what is sent ---


def test_timesync_is_answered() -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    request = vehicle.frame(mavlink.MAVLink_timesync_message(0, 123_456_789_012))
    reception = session.receive(vehicle.position(1000) + request, PEER, 2.5)
    assert len(reception.events) == 1
    assert len(reception.frames) == 2
    (answer,) = reception.replies
    reply = understood(session.encode(answer))
    assert (reply.tc1, reply.ts1) == (2_500_000_000, 123_456_789_012)
    theirs = vehicle.frame(mavlink.MAVLink_timesync_message(1, 2))
    reception = session.receive(theirs, PEER, 2.5)
    assert reception.replies == ()
    assert reception.events == (events.TimesyncReply(request_ns=2, vehicle_ns=1),)
    question = understood(session.encode(Timesync(0, 77)))
    assert (question.tc1, question.ts1) == (0, 77)


def test_timesync_is_answered_before_the_first_heartbeat() -> None:
    session = Session(SessionSettings())
    request = Sender(7).frame(mavlink.MAVLink_timesync_message(0, 5))
    (reply,) = session.receive(request, PEER, 0.0).replies
    answer = understood(session.encode(reply))
    assert answer.ts1 == 5
    assert answer.tc1 != 0
    ground_station = Sender(255, 190).frame(mavlink.MAVLink_timesync_message(0, 5))
    assert session.receive(ground_station, PEER, 1.0).replies == ()


def test_nothing_is_sent_before_a_vehicle_is_found_unless_set() -> None:
    assert Session(SessionSettings()).poll(0.0) == ()
    assert Session(SessionSettings(sends_first=True)).poll(0.0) == (Heartbeat(18),)
    session = Session(SessionSettings())
    frame = Sender(255, 190).heartbeat(8, vehicle_type=6)
    session.receive(frame, PEER, 0.0)
    assert session.poll(0.0) == ()


def beats(messages: tuple[Outgoing, ...]) -> list[int]:
    """Types of the heartbeats."""
    return [message.vehicle_type for message in messages if isinstance(message, Heartbeat)]


@pytest.mark.parametrize("autopilot", [PX4, ARDUPILOT])
def test_heartbeats_at_1_hz_of_an_onboard_controller(autopilot: int) -> None:
    session = Session(SessionSettings())
    session.receive(Sender().heartbeat(autopilot), PEER, 0.0)
    sent = [(0.1 * i, kind) for i in range(100) for kind in beats(session.poll(0.1 * i))]
    assert [kind for _, kind in sent] == [18] * 10
    assert [t for t, _ in sent] == pytest.approx(list(range(10)))


def test_heartbeat_with_the_system_id_of_the_vehicle_at_once_when_found() -> None:
    session = Session(SessionSettings(sends_first=True))
    assert beats(session.poll(0.0)) == [18]
    session.receive(Sender(7).heartbeat(PX4), PEER, 0.1)
    (beat, *_) = session.poll(0.1)
    assert session.encode(beat)[5:7] == bytes([7, 191])


def test_heartbeat_follows_vehicle_time_when_that_is_faster() -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    sent = 1  # when the vehicle was found
    for tick in range(1001):  # ten seconds of vehicle time in 0.2 s of host time
        session.receive(vehicle.position(10 * tick + 10), PEER, 0.0002 * tick)
        sent += len(beats(session.poll(0.0002 * tick)))
    assert sent == 11


def test_in_lockstep_host_time_changes_nothing() -> None:
    """Two sessions with the same datagrams at other host times, polled in between or not."""
    vehicle = Sender()
    datagrams = [vehicle.heartbeat(), *(vehicle.position(20 * tick) for tick in range(1, 300))]
    plain, polled = (Session(SessionSettings(lockstep=True)) for _ in range(2))
    for tick, datagram in enumerate(datagrams):
        expected = plain.receive(datagram, PEER, 0.001 * tick)
        assert polled.receive(datagram, PEER, 7.0 * tick) == expected
        assert polled.poll(7.0 * tick + 6.0) == plain.poll(0.001 * tick)
    assert polled.link_time_s == plain.link_time_s


def test_intervals_are_requested_at_once() -> None:
    session = Session(SessionSettings())
    session.receive(Sender().heartbeat(), PEER, 0.0)
    heartbeat, *requests = session.poll(0.0)
    assert heartbeat == Heartbeat(18)
    assert all(isinstance(m, CommandLong) and m.command == 511 for m in requests)
    sent = [understood(session.encode(request)) for request in requests]
    intervals_us = {int(m.param1): m.param2 for m in sent}
    assert intervals_us == {
        31: 10000.0,
        32: 10000.0,
        245: 200000.0,
        1: 500000.0,
        24: 200000.0,
        230: 500000.0,
        436: 20000.0,
        83: 125000.0,
        115: 20000.0,
    }
    assert session.poll(0.01) == ()


def test_mavlink_1_frames_are_decoded() -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    message = mavlink.MAVLink_attitude_quaternion_message(1000, *LEVEL, 0.1, 0.2, 0.3)
    frame = vehicle.frame(message, mavlink1=True)
    assert frame[0] == 0xFE
    reception = session.receive(frame + vehicle.position(1000), PEER, 0.0)
    assert [type(e).__name__ for e in reception.events] == ["Attitude", "LocalPosition"]
    assert reception.frames[0] == frame


def test_mode_bits() -> None:
    vehicle = Sender()
    session = pinned(vehicle)
    frame = vehicle.frame(mavlink.MAVLink_heartbeat_message(2, PX4, 128 | 1, OFFBOARD, 4, 3))
    reception = session.receive(frame, PEER, 0.0)
    assert reception.events == (events.Heartbeat("OFFBOARD", True, 4, 2),)
