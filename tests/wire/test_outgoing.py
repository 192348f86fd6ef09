"""Sent messages and log records, decoded by pymavlink."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from vehicle_frames import ARDUPILOT, PX4, Sender, pinned, understood

from offboard.mavlink.dialects.ardupilot import ARDUPILOT as ARDUPILOT_DIALECT
from offboard.mavlink.dialects.px4 import PX4 as PX4_DIALECT
from offboard.mavlink.outgoing import (
    AttitudeTarget,
    CommandLong,
    Heartbeat,
    Outgoing,
    ParamRead,
    PositionTarget,
    ReferenceRecord,
    SolverRecord,
)
from offboard.mavlink.session import Session, SessionSettings
from offboard.mavlink.texts import TextAssembler, chunks
from offboard.model.command import Command, PositionCommand

LEVEL = AttitudeTarget(12.345, Command(9.81, (0.0, 0.0, 1.0), 0.0), 0.489, 9.81)
MOTION = ((1.0, 2.0, -3.0), (0.1, 0.2, 0.3), (0.4, 0.5, 0.6), 0.5, 0.25)
POSITION = PositionTarget(1.0, PositionCommand(*MOTION))


def sent(value: Outgoing, autopilot: int = PX4) -> Any:
    return understood(pinned(Sender(7), autopilot).encode(value))


# --- attitude and thrust ---


TILTED = (0.5, 0.0, math.cos(math.pi / 6))  # 30 degrees


@pytest.mark.parametrize(
    ("autopilot", "thrust_mps2", "direction", "body_z_down", "expected"),
    [
        (PX4, 12.0, TILTED, 0.9, 0.489 * 12.0 / 9.81),  # the tilt is not compensated
        # a thrust that holds the height: hover thrust, as ArduCopter divides it by the cosine
        (ARDUPILOT, 9.81 / TILTED[2], TILTED, None, 0.489),
        (ARDUPILOT, 12.0, TILTED, 0.9, 0.489 * 12.0 * 0.9 / 9.81),
        (PX4, 100.0, (0.0, 0.0, 1.0), None, 1.0),
        (PX4, -1.0, (0.0, 0.0, 1.0), None, 0.0),
        (ARDUPILOT, 9.81, (0.0, 0.0, -1.0), None, 0.0),
    ],
)
def test_thrust_is_scaled_for_each_autopilot(
    autopilot: int, thrust_mps2: float, direction: Any, body_z_down: Any, expected: float
) -> None:
    command = Command(thrust_mps2, direction, 0.0)
    value = AttitudeTarget(1.0, command, 0.489, 9.81, body_z_down)
    assert sent(value, autopilot).thrust == pytest.approx(expected, abs=1e-6)


def test_invalid_outgoing_values_are_refused() -> None:
    bad = (math.nan, math.inf, -math.inf)
    refused: list[tuple[Outgoing, str]] = [
        (replace(LEVEL, **{name: each}), "finite")  # type: ignore[arg-type]
        for name in ("time_s", "hover_thrust", "gravity_mps2", "body_z_down")
        for each in bad
    ]
    refused += [
        (replace(LEVEL, command=replace(LEVEL.command, **{name: each})), "finite")
        for name in ("thrust_mps2", "heading_rad")
        for each in bad
    ]
    refused += [
        (replace(LEVEL, command=Command(9.81, (math.nan, 0.0, 1.0), 0.0)), "finite"),
        (replace(LEVEL, command=Command(9.81, (0.0, 0.0, 2.0), 0.0)), "unit vector"),
        (replace(LEVEL, hover_thrust=1.0), "hover thrust"),
        (CommandLong(22, (math.inf,)), "finite"),
        (CommandLong(22, (1e39,)), "finite"),
        (PositionTarget(1.0, PositionCommand((0.0, math.nan, 0.0), *MOTION[1:])), "finite"),
        (replace(POSITION, time_s=-1.0), "finite"),
        (ParamRead(""), "1 to 16"),
        (ParamRead("A_NAME_OF_17_CHAR"), "1 to 16"),
        (SolverRecord(2.5, (0.0,) * 59, 3, "pso"), "58"),
    ]
    session = pinned(Sender(), ARDUPILOT)
    for value, why in refused:
        with pytest.raises(ValueError, match=why):
            session.encode(value)
    with pytest.raises(ValueError, match="no vehicle"):
        Session(SessionSettings()).encode(CommandLong.arm())


# --- commands and modes ---


@pytest.mark.parametrize(
    ("command", "number", "leading"),
    [
        (PX4_DIALECT.set_mode("AUTO.LAND"), 176, [1.0, 4.0, 6.0]),
        (PX4_DIALECT.take_off(500.0), 22, [0.0, 0.0, 0.0, *(math.nan,) * 3, 500.0]),
        (ARDUPILOT_DIALECT.hold(), 176, [1.0, 17.0]),
    ],
)
def test_commands_are_encoded_with_their_parameters(
    command: CommandLong, number: int, leading: list[float]
) -> None:
    """These are commands that no flight of tests/replay has sent to a real autopilot."""
    message = sent(command)
    assert (message.target_system, message.target_component, message.command) == (7, 1, number)
    parameters = [getattr(message, f"param{i}") for i in range(1, 8)]
    assert parameters == pytest.approx(leading + [0.0] * (7 - len(leading)), nan_ok=True)


# --- the others ---


def test_positions_and_references_are_encoded() -> None:
    """Their time stamp wraps at 32 bits."""
    session = pinned(Sender(7))
    for value, kind, component in (
        (POSITION, "SET_POSITION_TARGET_LOCAL_NED", 191),
        (
            ReferenceRecord(2**32 / 1e3 + 1.0, PositionCommand(*MOTION)),
            "POSITION_TARGET_LOCAL_NED",
            192,
        ),
    ):
        fields = understood(session.encode(value))
        assert (fields.get_type(), fields.get_srcComponent()) == (kind, component)
        assert (fields.time_boot_ms, fields.type_mask, fields.coordinate_frame) == (1000, 0, 1)
        given = [*MOTION[0], *MOTION[1], *MOTION[2], *MOTION[3:]]
        names = ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate")
        assert [getattr(fields, name) for name in names] == pytest.approx(given)


def test_log_records_use_separate_sequence_numbers() -> None:
    session = pinned(Sender())
    sequence = [session.encode(Heartbeat(18))[4] for _ in range(257)]
    assert sequence == [*range(256), 0]
    data = (1.0, math.nan, 1e300, -1e300, -2.5)
    message = understood(session.encode(SolverRecord(2.5, data, 3, "pso")))
    assert (message.time_usec, message.name, message.array_id) == (2_500_000, "pso", 3)
    kept = [1.0, math.nan, math.inf, -math.inf, -2.5, *(0.0,) * 53]
    assert message.data == pytest.approx(kept, nan_ok=True)
    assert message.get_seq() == 0
    assert session.encode(Heartbeat(18))[4] == 1


@pytest.mark.parametrize("length", [0, 50, 51, 100, 101, 999])
def test_long_texts_are_sent_in_chunks_and_rejoined(length: int) -> None:
    text = "".join(str(place % 10) for place in range(length))
    session, assembler = pinned(Sender(7)), TextAssembler()
    frames = [session.encode(chunk) for chunk in chunks(4, text, 7)]
    messages = [understood(frame) for frame in frames]
    assert "".join(message.text for message in messages) == text
    assert [m.chunk_seq for m in messages] == list(range(length // 50 + 1 if length > 50 else 1))
    joined = [whole for frame in frames for whole in assembler.add(frame[10:-2], 0.0)]
    assert [(whole.severity, whole.text) for whole in joined] == [(4, text)]
