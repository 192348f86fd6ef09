"""Decoding: converts messages that pymavlink has decoded to events in NED, FRD and SI.

A message becomes an event only if every field is finite and in range. `DECODERS` has the decoder of
each message id. This module knows no sequence numbers, no addresses and no clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from offboard.mavlink import events
from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.framing import payload_of

POSITION_LIMIT_M = 1e5
VELOCITY_LIMIT_MPS = 200.0
RATE_LIMIT_RADPS = 100.0
UNIT_LENGTHS = 0.9, 1.1  # range of the length of a valid quaternion
_PREARM_CHECK = 0x10000000  # MAV_SYS_STATUS_PREARM_CHECK
_RADIO = 0x10000  # MAV_SYS_STATUS_SENSOR_RC_RECEIVER
_SENSORS = {
    bit: sensor.name.removeprefix("MAV_SYS_STATUS_").removeprefix("SENSOR_")
    for bit, sensor in mavlink.enums["MAV_SYS_STATUS_SENSOR"].items()
}
# ESTIMATOR_STATUS_FLAGS and EKF_STATUS_FLAGS have the same bits
_EKF_BITS = dict(zip(events.ESTIMATE, (1, 2, 8, 32), strict=True))
_BY_GPS = 512  # ESTIMATOR_PRED_POS_HORIZ_ABS
ARMED = 0x80  # MAV_MODE_FLAG_SAFETY_ARMED
FIX_3D = 3  # GPS_FIX_TYPE; greater numbers are better fixes
_REAL32 = 9  # MAV_PARAM_TYPE
_UNSIGNED_TYPES, _SIGNED_TYPES = (1, 3, 5), (2, 4, 6)
_LANDED = ("unknown", "on_ground", "in_air", "takeoff", "landing")  # MAV_LANDED_STATE
# MAV_RESULT
_RESULTS = {
    number: result.name.removeprefix("MAV_RESULT_")
    for number, result in mavlink.enums["MAV_RESULT"].items()
}
# results that pymavlink's `all` lacks
_RESULTS |= {6: "CANCELLED", 9: "COMMAND_UNSUPPORTED_MAV_FRAME", 10: "NOT_IN_CONTROL"}
# innovation ratios in ESTIMATOR_STATUS and EKF_STATUS_REPORT: measurement -> field of the message
_PX4_ESTIMATOR, _ARDUPILOT_ESTIMATOR = 230, 193
_RATIOS = {
    _PX4_ESTIMATOR: {
        "velocity": "vel_ratio",
        "horizontal position": "pos_horiz_ratio",
        "height": "pos_vert_ratio",
        "heading": "mag_ratio",
        "height above ground": "hagl_ratio",
        "airspeed": "tas_ratio",
    },
    _ARDUPILOT_ESTIMATOR: {
        "velocity": "velocity_variance",
        "horizontal position": "pos_horiz_variance",
        "height": "pos_vert_variance",
        "compass": "compass_variance",
        "terrain": "terrain_alt_variance",
        "air": "airspeed_variance",
    },
}


class Address(NamedTuple):
    """MAVLink ids of the sender or the receiver of a message."""

    system_id: int
    component_id: int


def _heartbeat(message: Any, dialect: Dialect) -> events.Event:
    armed = bool(message.base_mode & ARMED)
    mode = dialect.mode_name(message.custom_mode)
    return events.Heartbeat(mode, armed, message.system_status, message.type)


def _current_mode(message: Any, dialect: Dialect) -> events.Event:
    return events.ModeReport(dialect.mode_name(message.custom_mode))


def _local_position(message: Any, _: Dialect) -> events.Event | None:
    x, y, z = position = message.x, message.y, message.z
    vx, vy, vz = velocity = message.vx, message.vy, message.vz
    far, fast = POSITION_LIMIT_M, VELOCITY_LIMIT_MPS
    # comparisons with NaN are false: these also refuse values that are not finite
    if not (-far < x < far and -far < y < far and -far < z < far):
        return None
    if not (-fast < vx < fast and -fast < vy < fast and -fast < vz < fast):
        return None
    return events.LocalPosition(message.time_boot_ms / 1000.0, position, velocity)


def _attitude(message: Any, _: Dialect) -> events.Event | None:
    w, x, y, z = message.q1, message.q2, message.q3, message.q4
    p, q, r = rates = message.rollspeed, message.pitchspeed, message.yawspeed
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not UNIT_LENGTHS[0] < norm < UNIT_LENGTHS[1]:
        return None
    limit = RATE_LIMIT_RADPS
    if not (-limit < p < limit and -limit < q < limit and -limit < r < limit):
        return None
    unit = (w / norm, x / norm, y / norm, z / norm)
    return events.Attitude(message.time_boot_ms / 1000.0, unit, rates)


def _thrust_report(message: Any, _: Dialect) -> events.Event | None:
    if not math.isfinite(message.thrust):
        return None
    # ArduCopter reports down to -0.2 during landing
    return events.ThrustReport(min(max(message.thrust, 0.0), 1.0))


def _gps_fix(message: Any, _: Dialect) -> events.Event:
    return events.GpsFix() if message.fix_type >= FIX_3D else events.NoFix(message.fix_type)


def _system_health(message: Any, _: Dialect) -> events.Event:
    health, percent = message.onboard_control_sensors_health, message.battery_remaining
    present = message.onboard_control_sensors_present
    enabled = message.onboard_control_sensors_enabled
    failed = enabled & ~health & ~_PREARM_CHECK
    return events.SystemHealth(
        # with ARMING_CHECK 0, ArduPilot reports the check as present but not enabled
        prearm_ok=bool((health | present & ~enabled) & _PREARM_CHECK),
        battery_remaining=percent * 1e-2 if 0 <= percent <= 100 else None,
        radio_ok=bool(present & health & _RADIO),
        unhealthy=tuple(name for bit, name in _SENSORS.items() if failed & bit),
    )


def _estimator(message: Any, _: Dialect) -> events.Event:
    names = _RATIOS[message.get_msgId()].items()
    ratios = ((name, getattr(message, field)) for name, field in names)
    accuracy_m = getattr(message, "pos_horiz_accuracy", math.nan)  # not in ArduPilot's message
    px4 = message.get_msgId() == _PX4_ESTIMATOR
    return events.EstimatorReport(
        valid=frozenset(part for part, bit in _EKF_BITS.items() if message.flags & bit),
        ratios=tuple((name, ratio) for name, ratio in ratios if math.isfinite(ratio)),
        accuracy_m=accuracy_m if math.isfinite(accuracy_m) else None,
        by_gps=not px4 or bool(message.flags & _BY_GPS),
    )


def _version(message: Any, _: Dialect) -> events.Event:
    # ArduPilot sends only uid2
    uid = message.uid or int.from_bytes(bytes(message.uid2), "little")
    version = events.FirmwareVersion(*message.flight_sw_version.to_bytes(4, "big"))
    return events.VehicleIdentity(uid, version)


def _landed(message: Any, _: Dialect) -> events.Event:
    state = message.landed_state
    return events.Landed(_LANDED[state] if state < len(_LANDED) else _LANDED[0])


def _command_ack(message: Any, _: Dialect) -> events.Event:
    result = message.result
    return events.CommandAck(message.command, _RESULTS.get(result, f"UNKNOWN({result})"))


def _parameter(message: Any, dialect: Dialect) -> events.Event | None:
    name, value, kind = message.param_id, message.param_value, message.param_type
    if all(name != watched.name for watched in dialect.watched_parameters):
        return None  # a reply to a ground station that reads all parameters
    if dialect.integers_bytewise and kind != _REAL32:
        if kind not in _UNSIGNED_TYPES + _SIGNED_TYPES:
            return None
        # from the bytes: read as a float they may be a signalling NaN, which Python changes
        first = payload_of(bytes(message.get_msgbuf()))[:4].ljust(4, b"\0")
        value = int.from_bytes(first, "little", signed=kind in _SIGNED_TYPES)
    if not math.isfinite(value):
        return None
    return events.Parameter(name, float(value))


def printable(data: bytes) -> str:
    """Received text with spaces for control characters, so that a terminal can print it."""
    text = data.decode("utf-8", errors="replace")
    return "".join(c if c.isprintable() else " " for c in text).strip()


DECODERS: Mapping[int, Callable[[Any, Dialect], events.Event | None]] = {
    0: _heartbeat,
    1: _system_health,
    22: _parameter,
    31: _attitude,
    24: _gps_fix,
    32: _local_position,
    77: _command_ack,
    83: _thrust_report,
    148: _version,
    _ARDUPILOT_ESTIMATOR: _estimator,
    _PX4_ESTIMATOR: _estimator,
    245: _landed,
    436: _current_mode,
}
