"""Messages and records other than SET_ATTITUDE_TARGET, read back by pymavlink."""

from __future__ import annotations

import math
import struct

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_frames import PX4, Sender, pinned, understood

from offboard.mavlink.dialects.ardupilot import ARDUPILOT as ARDUPILOT_DIALECT
from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.dialects.px4 import PX4 as PX4_DIALECT
from offboard.mavlink.outgoing import (
    CommandLong,
    Heartbeat,
    ParamRead,
    PositionTarget,
    ReferenceRecord,
    SolverRecord,
    StatusTextOut,
)
from offboard.mavlink.session import Session, SessionSettings
from offboard.mavlink.texts import TextAssembler, chunks


def parameters(command: CommandLong) -> list[float]:
    message = understood(pinned(Sender()).encode(command))
    assert message.get_type() == "COMMAND_LONG"
    assert (message.target_system, message.target_component) == (1, 1)
    assert message.command == command.command
    return [getattr(message, f"param{i}") for i in range(1, 8)]


@pytest.mark.parametrize(
    ("command", "number", "leading"),
    [
        (CommandLong.arm(), 400, [1.0, 0.0]),
        (CommandLong.disarm(), 400, [0.0, 0.0]),
        (CommandLong.land(), 21, [0.0]),
        (CommandLong.message_interval(31, 100.0), 511, [31.0, 10000.0]),
        (PX4_DIALECT.engage(), 176, [1.0, 6.0, 0.0]),
        (PX4_DIALECT.hold(), 176, [1.0, 4.0, 3.0]),
        (PX4_DIALECT.set_mode("AUTO.LAND"), 176, [1.0, 4.0, 6.0]),
        (ARDUPILOT_DIALECT.engage(), 176, [1.0, 4.0, 0.0]),
        (ARDUPILOT_DIALECT.hold(), 176, [1.0, 17.0, 0.0]),
        (ARDUPILOT_DIALECT.take_off(5.0), 22, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 5.0]),
    ],
)
def test_commands(command: CommandLong, number: int, leading: list[float]) -> None:
    assert command.command == number
    assert parameters(command) == leading + [0.0] * (7 - len(leading))


def test_px4_takes_off_at_its_present_place() -> None:
    sent = parameters(PX4_DIALECT.take_off(500.0))
    assert all(math.isnan(p) for p in sent[3:6])
    assert sent[6] == 500.0


@pytest.mark.parametrize("dialect", [PX4_DIALECT, ARDUPILOT_DIALECT], ids=lambda d: d.name)
def test_modes_named_by_the_dialect_exist(dialect: Dialect) -> None:
    for name in (dialect.engage_mode, dialect.hold_mode, dialect.land_mode):
        assert name in dialect.modes.values()
    assert dialect.mode_name(0xFF00FFFF) == "UNKNOWN(0xff00ffff)"
    with pytest.raises(ValueError, match=f"no mode 'NONSENSE'; it has .*{dialect.engage_mode}"):
        dialect.set_mode("NONSENSE")


def test_modes_have_the_numbers_of_the_specification() -> None:
    modes = {name: number for number, name in PX4_DIALECT.modes.items()}
    assert modes["OFFBOARD"] == 0x00060000
    assert modes["AUTO.LOITER"] == 0x03040000
    assert modes["AUTO.TAKEOFF"] == 0x02040000
    assert modes["AUTO.LAND"] == 0x06040000
    assert modes["POSCTL"] == 0x00030000
    known = {
        number: entry.name.removeprefix("COPTER_MODE_")
        for number, entry in mavlink.enums["COPTER_MODE"].items()
        if not entry.name.endswith("ENUM_END")
    }
    assert dict(ARDUPILOT_DIALECT.modes) == known


@pytest.mark.parametrize(
    "value", [0, 1, -1, 8, 2**31 - 1, -(2**31), -8388607, -4194305, 2139095041, 2143289343]
)
def test_px4_sends_integer_parameters_as_bytes(value: int) -> None:
    """The last four are signalling NaN as floats, which pymavlink changes: written as bytes."""
    vehicle = Sender()
    session = pinned(vehicle, PX4)
    echo = vehicle.frame(mavlink.MAVLink_param_value_message(b"COM_RC_IN_MODE", 0.0, 6, 1, 0))
    echo = resealed(echo, 22, struct.pack("<i", value))
    (event,) = session.receive(echo, ("127.0.0.1", 14580), 1.0).events
    assert event.value == value  # type: ignore[union-attr]


def resealed(frame: bytes, message_id: int, first: bytes) -> bytes:
    """`frame` with its first payload bytes replaced and a checksum of pymavlink's own."""
    body = frame[1:10] + first + frame[10 + len(first) : -2]
    crc = mavlink.x25crc(body)
    crc.accumulate(bytes([mavlink.mavlink_map[message_id].crc_extra]))
    return frame[:1] + body + struct.pack("<H", crc.crc)


def test_param_read() -> None:
    message = understood(pinned(Sender()).encode(ParamRead("COM_OF_LOSS_T")))
    assert (message.param_id, message.param_index) == ("COM_OF_LOSS_T", -1)
    for name in ("", "A_NAME_OF_17_CHAR"):
        with pytest.raises(ValueError, match="1 to 16"):
            pinned(Sender()).encode(ParamRead(name))


def position_target(**changes: object) -> PositionTarget:
    values: dict[str, object] = {
        "time_s": 1.0,
        "position_ned_m": (1.0, 2.0, -3.0),
        "velocity_ned_mps": (0.1, 0.2, 0.3),
        "acceleration_ned_mps2": (0.4, 0.5, 0.6),
        "heading_rad": 0.5,
        "heading_rate_radps": 0.25,
    }
    return PositionTarget(**(values | changes))  # type: ignore[arg-type]


def test_position_target() -> None:
    message = understood(pinned(Sender(7)).encode(position_target()))
    assert message.get_type() == "SET_POSITION_TARGET_LOCAL_NED"
    assert (message.target_system, message.target_component) == (7, 1)
    assert (message.time_boot_ms, message.type_mask, message.coordinate_frame) == (1000, 0, 1)
    assert (message.x, message.y, message.z) == (1.0, 2.0, -3.0)
    assert (message.vx, message.vy, message.vz) == pytest.approx((0.1, 0.2, 0.3))
    assert (message.afx, message.afy, message.afz) == pytest.approx((0.4, 0.5, 0.6))
    assert (message.yaw, message.yaw_rate) == (0.5, 0.25)


def test_records_for_the_log() -> None:
    session = pinned(Sender(7), record_component_id=192)
    reference = ReferenceRecord(2.5, (1.0, 2.0, -3.0), (0.1, 0.2, 0.3), (0.4, 0.5, 0.6), -0.5, 0.25)
    message = understood(session.encode(reference))
    assert message.get_type() == "POSITION_TARGET_LOCAL_NED"
    assert (message.get_srcSystem(), message.get_srcComponent()) == (7, 192)
    assert (message.time_boot_ms, message.type_mask) == (2500, 0)
    assert (message.x, message.vy, message.afz, message.yaw) == pytest.approx((1.0, 0.2, 0.6, -0.5))
    data = (1.0, math.nan, 1e300, -1e300, -2.5)
    message = understood(session.encode(SolverRecord(2.5, data, array_id=3)))
    assert message.get_type() == "DEBUG_FLOAT_ARRAY"
    assert (message.time_usec, message.name, message.array_id) == (2_500_000, "pso", 3)
    assert message.data[:5] == pytest.approx(
        [1.0, math.nan, math.inf, -math.inf, -2.5], nan_ok=True
    )
    assert message.data[5:] == [0.0] * 53
    with pytest.raises(ValueError, match="58"):
        session.encode(SolverRecord(2.5, (0.0,) * 59))


def test_sequence_numbers_count_per_component() -> None:
    session = pinned(Sender(), record_component_id=192)
    sequence = [session.encode(Heartbeat(18))[4] for _ in range(257)]
    assert sequence == [*range(256), 0]
    assert session.encode(SolverRecord(0.0, ()))[4] == 0
    assert session.encode(Heartbeat(18))[4] == 1


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (
            CommandLong.arm(),
            mavlink.MAVLink_command_long_message(7, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0),
        ),
        (Heartbeat(0), mavlink.MAVLink_heartbeat_message(0, 8, 0, 0, 4, 3)),
        (StatusTextOut(0, b""), mavlink.MAVLink_statustext_message(0, b"", 0, 0)),
    ],
    ids=["zeros at the end", "zeros at the beginning", "nothing but zeros"],
)
def test_frames_are_byte_for_byte_those_of_pymavlink(
    value: CommandLong | Heartbeat | StatusTextOut, message: object
) -> None:
    assert pinned(Sender(7)).encode(value) == Sender(7, 191).frame(message)


def test_heartbeat_and_text_of_ours() -> None:
    session = pinned(Sender(7))
    message = understood(session.encode(Heartbeat(18)))
    assert (message.type, message.autopilot, message.mavlink_version) == (18, 8, 3)
    assert (message.get_srcSystem(), message.get_srcComponent()) == (7, 191)
    message = understood(session.encode(StatusTextOut(4, b"x" * 50)))
    assert (message.severity, message.text, message.id) == (4, "x" * 50, 0)


@pytest.mark.parametrize("length", [0, 1, 50, 51, 99, 100, 101, 999])
def test_long_texts_are_joined_again(length: int) -> None:
    text = "".join(str(place % 10) for place in range(length))
    session, assembler = pinned(Sender(7)), TextAssembler()
    frames = [session.encode(chunk) for chunk in chunks(4, text, 7)]
    messages = [understood(frame) for frame in frames]
    assert len(messages) == (1 if length <= 50 else length // 50 + 1)
    assert "".join(message.text for message in messages) == text
    assert [message.chunk_seq for message in messages] == list(range(len(messages)))
    joined = [whole for frame in frames for whole in assembler.add(frame[10:-2], 0.0)]
    assert [(whole.severity, whole.text) for whole in joined] == [(4, text)]


def test_a_message_to_the_vehicle_needs_a_vehicle() -> None:
    with pytest.raises(ValueError, match="no vehicle"):
        Session(SessionSettings()).encode(CommandLong.arm())


@pytest.mark.parametrize(
    "value",
    [
        CommandLong(22, (math.inf,)),
        CommandLong(22, (1e39,)),
        position_target(position_ned_m=(0.0, math.nan, 0.0)),
        position_target(heading_rad=math.nan),
        position_target(time_s=-1.0),
    ],
)
def test_what_is_not_finite_is_refused(value: CommandLong | PositionTarget) -> None:
    with pytest.raises(ValueError, match="finite"):
        pinned(Sender()).encode(value)


def test_problem_of_a_parameter_names_the_command_that_fixes_it() -> None:
    watched = {p.name: p for d in (PX4_DIALECT, ARDUPILOT_DIALECT) for p in d.watched_parameters}
    options = watched["GUID_OPTIONS"]
    assert options.fault(8.0) is None
    assert options.fault(10.0) is None
    assert str(options.fault(2.0)).endswith("fix='param set GUID_OPTIONS 10')")
    assert watched["COM_OF_LOSS_T"].fault(1.0) is None
    assert str(watched["COM_OF_LOSS_T"].fault(0.0)).endswith("fix='param set COM_OF_LOSS_T 1')")
    assert str(watched["ATC_ANGLE_BOOST"].fault(0.0)).endswith("param set ATC_ANGLE_BOOST 1')")
