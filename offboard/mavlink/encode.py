"""Values of outgoing.py turned into message ids and payloads: units, quaternion, thrust.

The last check before the vehicle: what is not finite or out of range is refused with ValueError.
Knows no sequence numbers, no peers and no clock. pymavlink's dialect classes supply the layouts.
"""

from __future__ import annotations

import math
import struct
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from offboard.mavlink import events
from offboard.mavlink.decode import Address
from offboard.mavlink.dialects.base import Dialect, ParameterEncoding, ThrustRule
from offboard.mavlink.outgoing import (
    AttitudeTarget,
    CommandLong,
    ConfigurationRecord,
    Heartbeat,
    Outgoing,
    ParamRead,
    ParamSet,
    PositionTarget,
    ReferenceRecord,
    SolverRecord,
    StatusTextOut,
    Timesync,
)
from offboard.model import frames

_LOCAL_NED = 1  # MAV_FRAME_LOCAL_NED
_INT32, _REAL32 = 6, 9  # MAV_PARAM_TYPE
_FLOAT32_MAX = 3.4028234663852886e38


class Packed(NamedTuple):
    """A message without its frame."""

    message_id: int
    payload: bytes


def encode(outgoing: Outgoing, target: Address | None, dialect: Dialect | None) -> Packed:
    """Message id and payload. ValueError: not finite, out of range, or no vehicle to send it to."""
    if isinstance(outgoing, AttitudeTarget):
        return _encode_attitude_target(outgoing, *_vehicle(target, dialect))
    if isinstance(outgoing, PositionTarget):
        return _encode_position_target(outgoing, _vehicle(target, dialect)[0])
    if isinstance(outgoing, CommandLong):
        return _encode_command(outgoing, _vehicle(target, dialect)[0])
    if isinstance(outgoing, ParamRead):
        return _encode_param_read(outgoing, _vehicle(target, dialect)[0])
    if isinstance(outgoing, ParamSet):
        return _encode_param_set(outgoing, *_vehicle(target, dialect))
    if isinstance(outgoing, ReferenceRecord):
        return _encode_reference(outgoing)
    if isinstance(outgoing, SolverRecord):
        return _encode_solver(outgoing)
    if isinstance(outgoing, ConfigurationRecord):
        return _encode_configuration(outgoing)
    return _encode_housekeeping(outgoing)


def _vehicle(target: Address | None, dialect: Dialect | None) -> tuple[Address, Dialect]:
    if target is None or dialect is None:
        raise ValueError("no vehicle has been heard yet: there is nobody to send this to")
    return target, dialect


def _pack(message: Any, **fields: Any) -> Packed:
    """Payload in wire order, arrays flattened."""
    ordered: list[Any] = []
    for name in message.ordered_fieldnames:
        value = fields[name]
        if isinstance(value, tuple):
            ordered.extend(value)
        else:
            ordered.append(value)
    return Packed(message.id, message.unpacker.pack(*ordered))


def _boot_ms(time_s: float) -> int:
    if not (math.isfinite(time_s) and time_s >= 0.0):
        raise ValueError(f"vehicle time must be finite and not negative, not {time_s!r}")
    return round(time_s * 1e3) & 0xFFFFFFFF


def _finite(name: str, *values: float) -> None:
    for value in values:
        if not (math.isfinite(value) and abs(value) <= _FLOAT32_MAX):
            raise ValueError(f"{name} must be finite, not {value!r}")


def normalised_thrust(target: AttitudeTarget, rule: ThrustRule) -> float:
    """Thrust 0 .. 1: u = u_h T / g, times the body's b_z where the autopilot divides by it."""
    _finite("thrust", target.thrust_mps2, target.hover_thrust, target.gravity_mps2)
    if not (0.0 < target.hover_thrust < 1.0 and target.gravity_mps2 > 0.0):
        raise ValueError(
            f"hover thrust must be within 0 and 1 and gravity positive, "
            f"not {target.hover_thrust!r} and {target.gravity_mps2!r}"
        )
    thrust = target.hover_thrust * target.thrust_mps2 / target.gravity_mps2
    if rule is ThrustRule.TILT_COMPENSATED:
        down = target.thrust_direction_ned[2] if target.body_z_down is None else target.body_z_down
        _finite("body_z_down", down)
        thrust *= down
    return min(max(thrust, 0.0), 1.0)


def _attitude_quaternion(target: AttitudeTarget) -> events.Quaternion:
    direction = np.asarray(target.thrust_direction_ned, dtype=np.float64)
    _finite("thrust direction and course", *direction, target.course_rad)
    norm = float(np.linalg.norm(direction))
    if not 0.9 < norm < 1.1:
        raise ValueError(f"thrust direction must be a unit vector; its length is {norm:g}")
    quaternion = frames.quaternion_from_thrust_direction(direction / norm, target.course_rad)
    # last of all: ArduCopter drops a quaternion that is off unit length by 0.0005
    quaternion = quaternion / np.linalg.norm(quaternion)
    w, x, y, z = (float(c) for c in (quaternion if quaternion[0] >= 0.0 else -quaternion))
    _finite("attitude", w, x, y, z)
    return w, x, y, z


def _encode_attitude_target(value: AttitudeTarget, target: Address, dialect: Dialect) -> Packed:
    return _pack(
        mavlink.MAVLink_set_attitude_target_message,
        time_boot_ms=_boot_ms(value.time_s),
        q=_attitude_quaternion(value),
        body_roll_rate=0.0,
        body_pitch_rate=0.0,
        body_yaw_rate=0.0,
        thrust=normalised_thrust(value, dialect.thrust_rule),
        target_system=target.system_id,
        target_component=target.component_id,
        type_mask=dialect.attitude_type_mask,
    )


def _triple(name: str, value: events.Triple | None) -> events.Triple:
    if value is None:
        return (0.0, 0.0, 0.0)
    _finite(name, *value)
    return value


def _encode_position_target(value: PositionTarget, target: Address) -> Packed:
    parts = (  # POSITION_TARGET_TYPEMASK: the bits of what is to be ignored
        (value.position_ned_m, 0b111),
        (value.velocity_ned_mps, 0b111 << 3),
        (value.acceleration_ned_mps2, 0b111 << 6),
        (value.course_rad, 1 << 10),
        (value.course_rate_radps, 1 << 11),
    )
    return _position_target(
        mavlink.MAVLink_set_position_target_local_ned_message,
        value,
        sum(bits for part, bits in parts if part is None),
        target_system=target.system_id,
        target_component=target.component_id,
    )


def _encode_reference(value: ReferenceRecord) -> Packed:
    return _position_target(mavlink.MAVLink_position_target_local_ned_message, value, 0)


def _position_target(
    message: Any, value: PositionTarget | ReferenceRecord, type_mask: int, **address: int
) -> Packed:
    """The fields that the commanded and the logged target have in common."""
    x, y, z = _triple("position", value.position_ned_m)
    vx, vy, vz = _triple("velocity", value.velocity_ned_mps)
    afx, afy, afz = _triple("acceleration", value.acceleration_ned_mps2)
    yaw, yaw_rate = value.course_rad or 0.0, value.course_rate_radps or 0.0
    _finite("course and its rate", yaw, yaw_rate)
    return _pack(
        message,
        time_boot_ms=_boot_ms(value.time_s),
        coordinate_frame=_LOCAL_NED,
        type_mask=type_mask,
        x=x,
        y=y,
        z=z,
        vx=vx,
        vy=vy,
        vz=vz,
        afx=afx,
        afy=afy,
        afz=afz,
        yaw=yaw,
        yaw_rate=yaw_rate,
        **address,
    )


def _encode_command(value: CommandLong, target: Address) -> Packed:
    parameters = value.parameters + (0.0,) * (7 - len(value.parameters))
    if len(parameters) != 7:
        raise ValueError(f"COMMAND_LONG has seven parameters, not {len(parameters)}")
    _finite("a command parameter", *(p for p in parameters if not math.isnan(p)))
    return _pack(
        mavlink.MAVLink_command_long_message,
        target_system=target.system_id,
        target_component=target.component_id,
        command=value.command,
        confirmation=value.confirmation,
        **{f"param{i}": p for i, p in enumerate(parameters, start=1)},
    )


def _param_name(name: str) -> bytes:
    data = name.encode("ascii", errors="replace")
    if not 1 <= len(data) <= 16:
        raise ValueError(f"a parameter name has 1 to 16 characters: {name!r}")
    return data


def _encode_param_read(value: ParamRead, target: Address) -> Packed:
    return _pack(
        mavlink.MAVLink_param_request_read_message,
        target_system=target.system_id,
        target_component=target.component_id,
        param_id=_param_name(value.name),
        param_index=-1,
    )


def _encode_param_set(value: ParamSet, target: Address, dialect: Dialect) -> Packed:
    _finite(value.name, value.value)
    integer = isinstance(value.value, int)
    bytewise = integer and dialect.parameter_encoding is ParameterEncoding.BYTEWISE
    if integer and not -(2**31) <= value.value < 2**31:
        raise ValueError(f"{value.name} must fit 32 bits, not {value.value!r}")
    packed = _pack(
        mavlink.MAVLink_param_set_message,
        target_system=target.system_id,
        target_component=target.component_id,
        param_id=_param_name(value.name),
        param_value=0.0 if bytewise else float(value.value),
        param_type=_INT32 if integer else _REAL32,
    )
    if not bytewise:
        return packed
    # param_value is first on the wire; through a float some integers would lose a bit
    return packed._replace(payload=struct.pack("<i", value.value) + packed.payload[4:])


def _encode_solver(value: SolverRecord) -> Packed:
    message = mavlink.MAVLink_debug_float_array_message
    room = message.array_lengths[message.ordered_fieldnames.index("data")]
    if len(value.data) > room:
        raise ValueError(f"DEBUG_FLOAT_ARRAY holds {room} numbers, not {len(value.data)}")
    data = tuple(_float32(v) for v in value.data) + (0.0,) * (room - len(value.data))
    return _pack(
        message,
        time_usec=_boot_ms(value.time_s) * 1000,
        name=value.name.encode("ascii", errors="replace")[:10],
        array_id=value.array_id,
        data=data,
    )


def _encode_configuration(value: ConfigurationRecord) -> Packed:
    message = mavlink.MAVLink_tunnel_message
    room = message.array_lengths[message.ordered_fieldnames.index("payload")]
    if len(value.data) > room:
        raise ValueError(f"TUNNEL holds {room} bytes, not {len(value.data)}")
    return _pack(
        message,
        target_system=0,
        target_component=0,
        payload_type=value.payload_type,
        payload_length=len(value.data),
        payload=tuple(value.data.ljust(room, b"\0")),
    )


def _float32(value: float) -> float:
    """What a float32 holds of it: infinity beyond its range (log only; never sent)."""
    return value if not abs(value) > _FLOAT32_MAX else math.copysign(math.inf, value)


def _encode_housekeeping(value: Heartbeat | Timesync | StatusTextOut) -> Packed:
    if isinstance(value, Heartbeat):
        return _pack(
            mavlink.MAVLink_heartbeat_message,
            type=value.vehicle_type,
            autopilot=mavlink.MAV_AUTOPILOT_INVALID,
            base_mode=0,
            custom_mode=0,
            system_status=mavlink.MAV_STATE_ACTIVE,
            mavlink_version=3,
        )
    if isinstance(value, Timesync):
        return _pack(mavlink.MAVLink_timesync_message, tc1=value.tc1_ns, ts1=value.ts1_ns)
    return _pack(
        mavlink.MAVLink_statustext_message,
        severity=value.severity,
        text=value.data,
        id=value.text_id,
        chunk_seq=value.chunk,
    )
