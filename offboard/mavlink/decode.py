"""Decoding: payloads of verified frames become events in NED, FRD and SI, or are refused.

Every field is checked here to be finite and in range. Knows no sequence numbers, no addresses and
no clock. pymavlink's dialect classes supply ids and layouts.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from offboard.mavlink import events
from offboard.mavlink.counters import DropReason
from offboard.mavlink.dialects.base import Dialect, ParameterEncoding

POSITION_LIMIT_M = 1e5
VELOCITY_LIMIT_MPS = 200.0
RATE_LIMIT_RADPS = 100.0
_PREARM_CHECK = 0x10000000  # MAV_SYS_STATUS_PREARM_CHECK
_RADIO = 0x10000  # MAV_SYS_STATUS_SENSOR_RC_RECEIVER
_SENSORS = {
    bit: sensor.name.removeprefix("MAV_SYS_STATUS_").removeprefix("SENSOR_")
    for bit, sensor in mavlink.enums["MAV_SYS_STATUS_SENSOR"].items()
}
# ESTIMATOR_STATUS_FLAGS and EKF_STATUS_FLAGS have the same bits
_EKF_ATTITUDE, _EKF_VELOCITY, _EKF_POSITION, _EKF_HEIGHT = 1, 2, 8, 32
_ARMED = 0x80  # MAV_MODE_FLAG_SAFETY_ARMED
_FIX_3D = 3  # GPS_FIX_TYPE
_REAL32 = 9  # MAV_PARAM_TYPE
_UNSIGNED_TYPES, _SIGNED_TYPES = (1, 3, 5), (2, 4, 6)
_CURRENT_MODE = struct.Struct("<IIx")  # custom_mode, intended_custom_mode; not in pymavlink 2.4.50
_LANDED = ("unknown", "on_ground", "in_air", "takeoff", "landing")  # MAV_LANDED_STATE
_RESULTS = (  # MAV_RESULT
    "ACCEPTED",
    "TEMPORARILY_REJECTED",
    "DENIED",
    "UNSUPPORTED",
    "FAILED",
    "IN_PROGRESS",
    "CANCELLED",
    "COMMAND_LONG_ONLY",
    "COMMAND_INT_ONLY",
    "COMMAND_UNSUPPORTED_MAV_FRAME",
    "NOT_IN_CONTROL",
)


class Address(NamedTuple):
    """MAVLink ids of the sender or the receiver of a message."""

    system_id: int
    component_id: int


class Identity(NamedTuple):
    """MAV_TYPE and MAV_AUTOPILOT in a HEARTBEAT."""

    vehicle_type: int
    autopilot: int


class TextChunk(NamedTuple):
    """One STATUSTEXT. `last`: its text is terminated. `text_id` 0: a text of one chunk."""

    severity: int
    data: bytes
    text_id: int
    chunk: int
    last: bool


def _unpack(message: Any, payload: bytes) -> tuple[Any, ...]:
    """Fields in wire order, after adding the trailing zeros that MAVLink 2 omits."""
    layout: struct.Struct = message.unpacker
    return layout.unpack_from(payload.ljust(layout.size, b"\0"))


def decode(message_id: int, payload: bytes, dialect: Dialect) -> events.Event | DropReason | None:
    """The event in a payload, IMPLAUSIBLE, or None for a message without decoder."""
    decoder = _DECODERS.get(message_id)
    return None if decoder is None else decoder(payload, dialect)


def decode_command(message_id: int, payload: bytes) -> tuple[int, tuple[float, ...], Address]:
    """Command, parameters and receiver of a COMMAND_LONG (76) or a COMMAND_INT (75), whose
    parameters 5 to 7, a place, are left out."""
    if message_id == mavlink.MAVLINK_MSG_ID_COMMAND_LONG:
        *parameters, command, system_id, component_id, _ = _unpack(
            mavlink.MAVLink_command_long_message, payload
        )
    else:
        *parameters, _, _, _, command, system_id, component_id, _, _, _ = _unpack(
            mavlink.MAVLink_command_int_message, payload
        )
    return command, tuple(parameters), Address(system_id, component_id)


def decode_identity(payload: bytes) -> Identity:
    """MAV_TYPE and MAV_AUTOPILOT of a HEARTBEAT."""
    _, vehicle_type, autopilot, *_ = _unpack(mavlink.MAVLink_heartbeat_message, payload)
    return Identity(vehicle_type, autopilot)


def decode_custom_mode(payload: bytes) -> int:
    """HEARTBEAT.custom_mode."""
    return int.from_bytes(payload[:4], "little")


def decode_ack_address(payload: bytes) -> Address:
    """Receiver of a COMMAND_ACK; 0 means all."""
    *_, system_id, component_id = _unpack(mavlink.MAVLink_command_ack_message, payload)
    return Address(system_id, component_id)


def decode_timesync(payload: bytes) -> tuple[int, int]:
    """TIMESYNC (tc1, ts1) in nanoseconds; tc1 is 0 in a request."""
    tc1, ts1 = _unpack(mavlink.MAVLink_timesync_message, payload)
    return tc1, ts1


def decode_text_chunk(payload: bytes) -> TextChunk:
    """One STATUSTEXT."""
    severity, text, text_id, chunk = _unpack(mavlink.MAVLink_statustext_message, payload)
    data, terminator, _ = text.partition(b"\0")
    return TextChunk(severity, data, text_id, chunk, bool(terminator))


def _heartbeat(payload: bytes, dialect: Dialect) -> events.Event:
    custom_mode, kind, _, base_mode, status, _ = _unpack(mavlink.MAVLink_heartbeat_message, payload)
    return events.Heartbeat(dialect.mode_name(custom_mode), bool(base_mode & _ARMED), status, kind)


def _current_mode(payload: bytes, dialect: Dialect) -> events.Event:
    custom_mode, _ = _CURRENT_MODE.unpack_from(payload.ljust(_CURRENT_MODE.size, b"\0"))
    return events.ModeReport(dialect.mode_name(custom_mode))


def _local_position(payload: bytes, _: Dialect) -> events.Event | DropReason:
    boot_ms, x, y, z, vx, vy, vz = _unpack(mavlink.MAVLink_local_position_ned_message, payload)
    far, fast = POSITION_LIMIT_M, VELOCITY_LIMIT_MPS
    # comparisons with NaN are false: these refuse what is not finite, too
    if not (-far < x < far and -far < y < far and -far < z < far):
        return DropReason.IMPLAUSIBLE
    if not (-fast < vx < fast and -fast < vy < fast and -fast < vz < fast):
        return DropReason.IMPLAUSIBLE
    return events.LocalPosition(boot_ms / 1000.0, (x, y, z), (vx, vy, vz))


def _attitude(payload: bytes, _: Dialect) -> events.Event | DropReason:
    boot_ms, w, x, y, z, p, q, r, *_offset = _unpack(
        mavlink.MAVLink_attitude_quaternion_message, payload
    )
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not 0.9 < norm < 1.1:
        return DropReason.IMPLAUSIBLE
    limit = RATE_LIMIT_RADPS
    if not (-limit < p < limit and -limit < q < limit and -limit < r < limit):
        return DropReason.IMPLAUSIBLE
    return events.Attitude(boot_ms / 1000.0, (w / norm, x / norm, y / norm, z / norm), (p, q, r))


def _thrust_report(payload: bytes, _: Dialect) -> events.Event | DropReason:
    *_state, thrust, _mask = _unpack(mavlink.MAVLink_attitude_target_message, payload)
    if not math.isfinite(thrust):
        return DropReason.IMPLAUSIBLE
    return events.ThrustReport(min(max(thrust, 0.0), 1.0))  # ArduCopter's falls to -0.2 on landing


def _gps_fix(payload: bytes, _: Dialect) -> events.Event:
    fields = _unpack(mavlink.MAVLink_gps_raw_int_message, payload)
    fix, accuracy_mm = fields[8], fields[11]
    if fix < _FIX_3D:
        return events.NoFix(fix)
    return events.GpsFix(accuracy_mm * 1e-3 if accuracy_mm else None)


def _system_health(payload: bytes, _: Dialect) -> events.Event:
    fields = _unpack(mavlink.MAVLink_sys_status_message, payload)
    present, enabled, health, _, millivolts = fields[:5]
    percent, failed = fields[12], enabled & ~health & ~_PREARM_CHECK
    return events.SystemHealth(
        prearm_ok=bool(health & _PREARM_CHECK),
        battery_voltage_v=millivolts * 1e-3 if millivolts != 0xFFFF else None,
        battery_remaining=percent * 1e-2 if 0 <= percent <= 100 else None,
        radio_ok=bool(present & health & _RADIO),
        unhealthy=tuple(name for bit, name in _SENSORS.items() if failed & bit),
    )


def _px4_estimator(payload: bytes, _: Dialect) -> events.Event:
    _, velocity, position, height, mag, hagl, airspeed, accuracy_m, _, flags = _unpack(
        mavlink.MAVLink_estimator_status_message, payload
    )
    ratios = {"GPS velocity": velocity, "GPS position": position, "height": height, "heading": mag}
    ratios |= {"height above ground": hagl, "airspeed": airspeed}
    return _estimator(flags, ratios, accuracy_m if math.isfinite(accuracy_m) else None)


def _ardupilot_estimator(payload: bytes, _: Dialect) -> events.Event:
    velocity, position, height, compass, terrain, flags, airspeed = _unpack(
        mavlink.MAVLink_ekf_status_report_message, payload
    )
    ratios = {"GPS velocity": velocity, "GPS position": position, "height": height}
    return _estimator(flags, ratios | {"compass": compass, "terrain": terrain, "air": airspeed})


def _estimator(
    flags: int, ratios: dict[str, float], accuracy_m: float | None = None
) -> events.EstimatorReport:
    return events.EstimatorReport(
        attitude_ok=bool(flags & _EKF_ATTITUDE),
        velocity_ok=bool(flags & _EKF_VELOCITY),
        position_ok=bool(flags & _EKF_POSITION),
        height_ok=bool(flags & _EKF_HEIGHT),
        ratios=tuple((name, ratio) for name, ratio in ratios.items() if math.isfinite(ratio)),
        accuracy_m=accuracy_m,
    )


def _version(payload: bytes, _: Dialect) -> events.Event:
    _, uid, number, *more = _unpack(mavlink.MAVLink_autopilot_version_message, payload)
    uid = uid or int.from_bytes(bytes(more[-18:]), "little")  # uid2, the only one of ArduPilot
    return events.VehicleIdentity(uid, events.FirmwareVersion(*number.to_bytes(4, "big")))


def _system_time(payload: bytes, _: Dialect) -> events.Event:
    unix_us, _ = _unpack(mavlink.MAVLink_system_time_message, payload)
    return events.SystemTime(unix_us * 1e-6)


def _landed(payload: bytes, _: Dialect) -> events.Event:
    _, state = _unpack(mavlink.MAVLink_extended_sys_state_message, payload)
    return events.Landed(_LANDED[state] if state < len(_LANDED) else _LANDED[0])


def _command_ack(payload: bytes, _: Dialect) -> events.Event:
    command, result, *_address = _unpack(mavlink.MAVLink_command_ack_message, payload)
    return events.CommandAck(
        command, _RESULTS[result] if result < len(_RESULTS) else f"UNKNOWN({result})"
    )


def _parameter(payload: bytes, dialect: Dialect) -> events.Event | DropReason:
    value, _, _, name, kind = _unpack(mavlink.MAVLink_param_value_message, payload)
    if dialect.parameter_encoding is ParameterEncoding.BYTEWISE and kind != _REAL32:
        # from the bytes: as a float they may be a signalling NaN, which Python changes
        if kind not in _UNSIGNED_TYPES + _SIGNED_TYPES:
            return DropReason.IMPLAUSIBLE
        value = int.from_bytes(payload[:4].ljust(4, b"\0"), "little", signed=kind in _SIGNED_TYPES)
    if not math.isfinite(value):
        return DropReason.IMPLAUSIBLE
    text = printable(name.partition(b"\0")[0])
    return events.Parameter(text, float(value)) if text else DropReason.IMPLAUSIBLE


def printable(data: bytes) -> str:
    """Received text without control characters, safe to print on a terminal."""
    text = data.decode("utf-8", errors="replace")
    return "".join(c if c.isprintable() else " " for c in text).strip()


_DECODERS: Mapping[int, Callable[[bytes, Dialect], events.Event | DropReason | None]] = {
    0: _heartbeat,
    1: _system_health,
    2: _system_time,
    22: _parameter,
    31: _attitude,
    24: _gps_fix,
    32: _local_position,
    77: _command_ack,
    83: _thrust_report,
    148: _version,
    193: _ardupilot_estimator,
    230: _px4_estimator,
    245: _landed,
    436: _current_mode,
}
