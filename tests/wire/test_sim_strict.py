"""`--strict`: messages that PX4 ignores are reported, at most once a second, and counted."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_bench import NAN, Bench


def setpoint(**changed: object) -> object:
    fields: dict[str, object] = {
        "time_boot_ms": 0,
        "target_system": 1,
        "target_component": 1,
        "type_mask": 7,
        "q": (1.0, 0.0, 0.0, 0.0),
        "body_roll_rate": 0.0,
        "body_pitch_rate": 0.0,
        "body_yaw_rate": 0.0,
        "thrust": 0.5,
    }
    return mavlink.MAVLink_set_attitude_target_message(**(fields | changed))


def motion(mask: int, x: float, vx: float) -> object:
    values = (x, 0.0, -3.0, vx, *(0.0,) * 7)
    return mavlink.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, mask, *values)


SWALLOWED = [
    (setpoint(target_component=7), "SET_ATTITUDE_TARGET to component 7 is ignored"),
    (setpoint(type_mask=135), "SET_ATTITUDE_TARGET with mask 135 is no setpoint"),
    (setpoint(type_mask=71), "SET_ATTITUDE_TARGET without thrust is zero thrust"),
    (setpoint(thrust=NAN), "SET_ATTITUDE_TARGET thrust is not a number: zero thrust"),
    (setpoint(thrust=1.5), "SET_ATTITUDE_TARGET thrust is outside 0 .. 1"),
    (setpoint(q=(0.0,) * 4), "SET_ATTITUDE_TARGET quaternion is not of unit length"),
    (setpoint(q=(NAN,) * 4), "SET_ATTITUDE_TARGET quaternion is not of unit length"),
    (setpoint(q=(2.0, 0, 0, 0)), "SET_ATTITUDE_TARGET quaternion is not of unit length"),
    (setpoint(type_mask=128, body_yaw_rate=NAN), "SET_ATTITUDE_TARGET rates are not numbers"),
    (motion(2552, NAN, 0.0), "SET_POSITION_TARGET_LOCAL_NED x is not a number"),
    (mavlink.MAVLink_param_set_message(1, 1, b"NO_SUCH", 1.0, 9), "PARAM_SET of unknown NO_SUCH"),
    (
        mavlink.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", -1.0, 9),
        "PARAM_SET of COM_OF_LOSS_T is out of range",
    ),
    (
        mavlink.MAVLink_param_request_read_message(1, 1, b"NO_SUCH", -1),
        "PARAM_REQUEST_READ of unknown NO_SUCH",
    ),
]
RIGHT = [
    setpoint(),
    setpoint(target_component=0, type_mask=128, q=(NAN,) * 4),
    setpoint(target_system=9, thrust=NAN),
    motion(2552, 1.0, NAN),
    mavlink.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", 2.0, 9),
    mavlink.MAVLink_param_request_read_message(1, 1, b"", 3),
]


@pytest.mark.parametrize(("message", "sentence"), SWALLOWED, ids=[s for _, s in SWALLOWED])
def test_ignored_messages_are_reported_and_counted(message: object, sentence: str) -> None:
    bench = Bench(strict=True)
    bench.run(2.5, lambda: bench.send(message), period_s=0.1)
    assert bench.texts() == [f"Strict: {sentence}"] * 3
    assert bench.instance.complaints == {f"Strict: {sentence}": 25}


@pytest.mark.parametrize("message", RIGHT)
def test_correct_messages_are_not_reported(message: object) -> None:
    bench = Bench(strict=True)
    bench.send(message)
    bench.run(0.1)
    assert bench.texts() == []


def test_without_strict_nothing_is_reported() -> None:
    bench = Bench()
    for message, _ in SWALLOWED:
        bench.send(message)
    bench.run(0.1)
    assert bench.texts() == []
    assert bench.instance.complaints == {}
