"""Encoding: values of outgoing.py become messages of pymavlink: units, quaternion, thrust.

The last check before the vehicle: ValueError for what is not finite or out of range. `Encoder`
numbers the frames, and has them signed.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from offboard.mavlink import events
from offboard.mavlink.decode import Address
from offboard.mavlink.dialects.base import Dialect, ThrustRule
from offboard.mavlink.framing import Frame
from offboard.mavlink.outgoing import (
    AttitudeTarget,
    CommandLong,
    CommandResult,
    ConfigurationRecord,
    Heartbeat,
    Outgoing,
    ParamRead,
    PositionTarget,
    Record,
    ReferenceRecord,
    SolverRecord,
    StatusTextOut,
    Timesync,
)
from offboard.mavlink.signing import Signing
from offboard.model import frames

_LOCAL_NED = 1  # MAV_FRAME_LOCAL_NED
Message = Any  # of pymavlink, to be packed
_ECHOES = 256  # newest frames of ours that are recognised when they come back
FLOAT32_MAX = 3.4028234663852886e38


class Encoder:
    """Frames of what we send and record, each component id with its own sequence numbers. With
    `signing` all but records are signed."""

    def __init__(
        self, component_id: int, record_component_id: int, signing: Signing | None
    ) -> None:
        self._sending = mavlink.MAVLink(None, srcComponent=component_id)
        self._recording = mavlink.MAVLink(None, srcComponent=record_component_id)
        self._signing = signing
        self._sent: deque[bytes] = deque(maxlen=_ECHOES)

    def frame(
        self,
        outgoing: Outgoing,
        system_id: int,
        target: Address | None,
        dialect: Dialect | None,
    ) -> bytes:
        """The frame of a message from our system `system_id`; see `encode`."""
        message = encode(outgoing, target, dialect)
        recorded = isinstance(outgoing, Record)
        sender = self._recording if recorded else self._sending
        sender.srcSystem = system_id
        if self._signing and not recorded:
            frame = self._signing.pack(message, sender)
        else:
            frame = bytes(message.pack(sender))
        sender.seq = (sender.seq + 1) % 256
        self._sent.append(frame)
        return frame

    def is_echo(self, frame: Frame) -> bool:
        """Whether a frame is one of ours that came back."""
        return frame.component_id == self._sending.srcComponent and frame.raw in self._sent


def encode(outgoing: Outgoing, target: Address | None, dialect: Dialect | None) -> Message:
    """The message of `outgoing`, sent to `target`.

    Raises ValueError for a value that is not finite or out of range, and for a message to the
    vehicle while `target` or `dialect` is None.
    """
    match outgoing:
        case AttitudeTarget():
            return _attitude_target(outgoing, *_vehicle(target, dialect))
        case PositionTarget():
            return _position_target(outgoing, **_to(target, dialect))
        case CommandLong():
            return _command(outgoing, **_to(target, dialect))
        case ParamRead(name):
            return mavlink.MAVLink_param_request_read_message(
                **_to(target, dialect),
                param_id=_param_name(name),
                param_index=-1,
            )
        case ReferenceRecord():
            return _position_target(outgoing)
        case SolverRecord():
            return _solver(outgoing)
        case ConfigurationRecord():
            return _configuration(outgoing)
        case CommandResult(command, result, system_id, component_id):
            return mavlink.MAVLink_command_ack_message(
                command=command,
                result=result,
                progress=0,
                result_param2=0,
                target_system=system_id,
                target_component=component_id,
            )
        case Heartbeat(vehicle_type, system_status, custom_mode):
            return mavlink.MAVLink_heartbeat_message(
                type=vehicle_type,
                autopilot=mavlink.MAV_AUTOPILOT_INVALID,
                base_mode=0,
                custom_mode=custom_mode,
                system_status=system_status,
                mavlink_version=3,
            )
        case Timesync(tc1_ns, ts1_ns):
            return mavlink.MAVLink_timesync_message(tc1_ns, ts1_ns)
        case StatusTextOut(severity, data, text_id, chunk):
            return mavlink.MAVLink_statustext_message(
                severity=severity,
                text=data,
                id=text_id,
                chunk_seq=chunk,
            )


def _vehicle(target: Address | None, dialect: Dialect | None) -> tuple[Address, Dialect]:
    if target is None or dialect is None:
        raise ValueError("no vehicle has been found yet: there is no receiver for this message")
    return target, dialect


def _to(target: Address | None, dialect: Dialect | None) -> dict[str, int]:
    """The fields that hold the receiver."""
    address, _ = _vehicle(target, dialect)
    return {"target_system": address.system_id, "target_component": address.component_id}


def _boot_ms(time_s: float) -> int:
    if not (math.isfinite(time_s) and time_s >= 0.0):
        raise ValueError(f"vehicle time must be finite and not negative, not {time_s!r}")
    return round(time_s * 1e3) & 0xFFFFFFFF


def _finite(name: str, *values: float) -> None:
    for value in values:
        if not (math.isfinite(value) and abs(value) <= FLOAT32_MAX):
            raise ValueError(f"{name} must be finite, not {value!r}")


def _normalised_thrust(target: AttitudeTarget, rule: ThrustRule) -> float:
    """Thrust 0 .. 1: u = u_h T / g, times the body's b_z if the autopilot divides by it."""
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
    _finite("thrust direction and heading", *direction, target.heading_rad)
    norm = float(np.linalg.norm(direction))
    if not 0.9 < norm < 1.1:
        raise ValueError(f"thrust direction must be a unit vector; its length is {norm:g}")
    quaternion = frames.quaternion_from_thrust_direction(direction / norm, target.heading_rad)
    # last of all: ArduCopter drops a quaternion whose length differs from 1 by 0.0005
    quaternion = quaternion / np.linalg.norm(quaternion)
    w, x, y, z = (float(c) for c in (quaternion if quaternion[0] >= 0.0 else -quaternion))
    _finite("attitude", w, x, y, z)
    return w, x, y, z


def _attitude_target(value: AttitudeTarget, target: Address, dialect: Dialect) -> Message:
    return mavlink.MAVLink_set_attitude_target_message(
        time_boot_ms=_boot_ms(value.time_s),
        q=_attitude_quaternion(value),
        body_roll_rate=0.0,
        body_pitch_rate=0.0,
        body_yaw_rate=0.0,
        thrust=_normalised_thrust(value, dialect.thrust_rule),
        **_to(target, dialect),
        type_mask=dialect.attitude_type_mask,
    )


def _position_target(value: PositionTarget | ReferenceRecord, **to: int) -> Message:
    """SET_POSITION_TARGET_LOCAL_NED, or POSITION_TARGET_LOCAL_NED, which has no receiver."""
    command = mavlink.MAVLink_set_position_target_local_ned_message
    message = command if to else mavlink.MAVLink_position_target_local_ned_message
    numbers = {
        **dict(zip(("x", "y", "z"), value.position_ned_m, strict=True)),
        **dict(zip(("vx", "vy", "vz"), value.velocity_ned_mps, strict=True)),
        **dict(zip(("afx", "afy", "afz"), value.acceleration_ned_mps2, strict=True)),
        "yaw": value.heading_rad,
        "yaw_rate": value.heading_rate_radps,
    }
    _finite("a position target", *numbers.values())
    return message(
        time_boot_ms=_boot_ms(value.time_s),
        coordinate_frame=_LOCAL_NED,
        type_mask=0,
        **numbers,
        **to,
    )


def _command(value: CommandLong, **to: int) -> Message:
    parameters = value.parameters + (0.0,) * (7 - len(value.parameters))
    if len(parameters) != 7:
        raise ValueError(f"COMMAND_LONG has seven parameters, not {len(parameters)}")
    _finite("a command parameter", *(p for p in parameters if not math.isnan(p)))
    return mavlink.MAVLink_command_long_message(
        command=value.command,
        confirmation=value.confirmation,
        **{f"param{i}": p for i, p in enumerate(parameters, start=1)},
        **to,
    )


def _param_name(name: str) -> bytes:
    data = name.encode("ascii", errors="replace")
    if not 1 <= len(data) <= 16:
        raise ValueError(f"a parameter name has 1 to 16 characters: {name!r}")
    return data


def _capacity(message: Any, field: str, count: int) -> int:
    """Length of an array field, into which `count` values must fit."""
    capacity: int = message.array_lengths[message.ordered_fieldnames.index(field)]
    if count > capacity:
        raise ValueError(f"{message.msgname} holds {capacity} values, not {count}")
    return capacity


def _solver(value: SolverRecord) -> Message:
    message = mavlink.MAVLink_debug_float_array_message
    capacity = _capacity(message, "data", len(value.data))
    data = tuple(_float32(v) for v in value.data) + (0.0,) * (capacity - len(value.data))
    return message(
        time_usec=_boot_ms(value.time_s) * 1000,
        name=value.name.encode("ascii", errors="replace")[:10],
        array_id=value.array_id,
        data=data,
    )


def _float32(value: float) -> float:
    """The value, or infinity beyond the range of a float32 (log only; never sent)."""
    return value if not abs(value) > FLOAT32_MAX else math.copysign(math.inf, value)


def _configuration(value: ConfigurationRecord) -> Message:
    message = mavlink.MAVLink_tunnel_message
    capacity = _capacity(message, "payload", len(value.data))
    return message(
        target_system=0,
        target_component=0,
        payload_type=value.payload_type,
        payload_length=len(value.data),
        payload=tuple(value.data.ljust(capacity, b"\0")),
    )
