"""Values that are sent or recorded: one frozen class per message, which makes pymavlink's message.

Values are in NED, FRD, SI and vehicle time; `encode` converts to the units and frames of MAVLink.
It is the last check before the vehicle: it raises ValueError for a value that is not finite or out
of range. Records are written to the flight log and never sent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from offboard.mavlink.events import Quaternion
from offboard.model import frames
from offboard.model.command import Command, PositionCommand

Message = Any  # a message of pymavlink, which is not packed yet
FLOAT32_MAX = 3.4028234663852886e38
PIECE_BYTES = 128  # length of TUNNEL.payload
_LOCAL_NED = 1  # MAV_FRAME_LOCAL_NED
# SET_ATTITUDE_TARGET.type_mask for attitude and thrust: body rates are ignored. ArduCopter holds
# its position with masks 1 to 6, and ignores the message with 71 and 199
_ATTITUDE_AND_THRUST = 7


class Target(NamedTuple):
    """The vehicle that a message is for."""

    system_id: int
    component_id: int
    divides_by_tilt: bool  # see `Dialect`


class Outgoing:
    """A value that is sent or recorded."""

    __slots__ = ()

    def encode(self, target: Target | None) -> Message:
        """Make the message for the vehicle `target`. Raises ValueError for a value that is not
        finite or out of range, and for a message to the vehicle if `target` is None."""
        raise NotImplementedError


class Record(Outgoing):
    """A value that is written only to our log."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class AttitudeTarget(Outgoing):
    """SET_ATTITUDE_TARGET, attitude and thrust.

    `hover_thrust` is the normalised thrust that holds the weight. `body_z_down` is the down
    component of the vehicle's body z axis, which is the cosine of its tilt, at the time when the
    command acts; None: that of the commanded attitude. It is used for autopilots that divide the
    thrust by it.
    """

    time_s: float
    command: Command
    hover_thrust: float
    gravity_mps2: float
    body_z_down: float | None = None

    def encode(self, target: Target | None) -> Message:
        vehicle = _found(target)
        return mavlink.MAVLink_set_attitude_target_message(
            _boot_ms(self.time_s),
            vehicle.system_id,
            vehicle.component_id,
            _ATTITUDE_AND_THRUST,
            self.attitude(),
            body_roll_rate=0.0,
            body_pitch_rate=0.0,
            body_yaw_rate=0.0,
            thrust=self.normalised_thrust(divides_by_tilt=vehicle.divides_by_tilt),
        )

    def attitude(self) -> Quaternion:
        """The commanded attitude, FRD -> NED."""
        direction = np.asarray(self.command.thrust_direction_ned, dtype=np.float64)
        heading_rad = self.command.heading_rad
        _finite("thrust direction and heading", *direction, heading_rad)
        norm = float(np.linalg.norm(direction))
        if not 0.9 < norm < 1.1:
            raise ValueError(f"thrust direction must be a unit vector; its length is {norm:g}")
        quaternion = frames.quaternion_from_thrust_direction(direction / norm, heading_rad)
        # normalise again: ArduCopter drops a quaternion whose length differs from 1 by 0.0005
        quaternion = quaternion / np.linalg.norm(quaternion)
        w, x, y, z = (float(c) for c in (quaternion if quaternion[0] >= 0.0 else -quaternion))
        _finite("attitude", w, x, y, z)
        return w, x, y, z

    def normalised_thrust(self, *, divides_by_tilt: bool) -> float:
        """Thrust 0 .. 1: hover_thrust * thrust_mps2 / gravity_mps2, multiplied by the cosine of the
        vehicle's tilt if the autopilot divides by it."""
        command = self.command
        _finite("thrust", command.thrust_mps2, self.hover_thrust, self.gravity_mps2)
        if not (0.0 < self.hover_thrust < 1.0 and self.gravity_mps2 > 0.0):
            raise ValueError(
                f"hover thrust must be within 0 and 1 and gravity positive, "
                f"not {self.hover_thrust!r} and {self.gravity_mps2!r}"
            )
        thrust = self.hover_thrust * command.thrust_mps2 / self.gravity_mps2
        if divides_by_tilt:
            down = self.body_z_down
            down = command.thrust_direction_ned[2] if down is None else down
            _finite("body_z_down", down)
            thrust *= down
        return min(max(thrust, 0.0), 1.0)


@dataclass(frozen=True, slots=True)
class _Motion:
    time_s: float
    command: PositionCommand

    def _fields(self) -> tuple[float, ...]:
        """The fields from coordinate_frame to yaw_rate; type_mask is 0, so that all are in use."""
        numbers = self.command.numbers()
        _finite("a position target", *numbers)
        return _LOCAL_NED, 0, *numbers


@dataclass(frozen=True, slots=True)
class PositionTarget(_Motion, Outgoing):
    """SET_POSITION_TARGET_LOCAL_NED with all fields in use."""

    def encode(self, target: Target | None) -> Message:
        return mavlink.MAVLink_set_position_target_local_ned_message(
            _boot_ms(self.time_s), *_ids(target), *self._fields()
        )


@dataclass(frozen=True, slots=True)
class ReferenceRecord(_Motion, Record):
    """The reference at a tick, logged as POSITION_TARGET_LOCAL_NED."""

    def encode(self, target: Target | None) -> Message:
        return mavlink.MAVLink_position_target_local_ned_message(
            _boot_ms(self.time_s), *self._fields()
        )


@dataclass(frozen=True, slots=True)
class CommandLong(Outgoing):
    """COMMAND_LONG. NaN in `parameters` means "not given", as in MAVLink."""

    command: int
    parameters: tuple[float, ...] = ()  # up to seven; the rest is 0

    @classmethod
    def arm(cls) -> CommandLong:
        return cls(400, (1.0,))

    @classmethod
    def disarm(cls) -> CommandLong:
        """MAV_CMD_COMPONENT_ARM_DISARM; an autopilot refuses it while its land detector says that
        it flies."""
        return cls(400, (0.0,))

    @classmethod
    def land(cls) -> CommandLong:
        return cls(21)

    @classmethod
    def message(cls, message_id: int) -> CommandLong:
        """MAV_CMD_REQUEST_MESSAGE: request one message."""
        return cls(512, (float(message_id),))

    @classmethod
    def run_prearm_checks(cls) -> CommandLong:
        """MAV_CMD_RUN_PREARM_CHECKS: the vehicle reports failed checks by STATUSTEXT."""
        return cls(401)

    @classmethod
    def message_interval(cls, message_id: int, rate_hz: float) -> CommandLong:
        """MAV_CMD_SET_MESSAGE_INTERVAL; the interval is rounded to microseconds."""
        return cls(511, (float(message_id), float(round(1e6 / rate_hz))))

    def encode(self, target: Target | None) -> Message:
        parameters = self.parameters + (0.0,) * (7 - len(self.parameters))
        _finite("a command parameter", *(p for p in parameters if not math.isnan(p)))
        return mavlink.MAVLink_command_long_message(*_ids(target), self.command, 0, *parameters)


@dataclass(frozen=True, slots=True)
class CommandResult(Outgoing):
    """COMMAND_ACK of a command that was sent to us; `result` is a MAV_RESULT."""

    command: int
    result: int
    system_id: int  # ids of the sender of the command
    component_id: int

    def encode(self, target: Target | None) -> Message:
        return mavlink.MAVLink_command_ack_message(
            self.command,
            self.result,
            target_system=self.system_id,
            target_component=self.component_id,
        )


@dataclass(frozen=True, slots=True)
class ParamRead(Outgoing):
    """PARAM_REQUEST_READ by name, at most 16 characters."""

    name: str

    def encode(self, target: Target | None) -> Message:
        data = self.name.encode("ascii", errors="replace")
        if not 1 <= len(data) <= 16:
            raise ValueError(f"a parameter name has 1 to 16 characters: {self.name!r}")
        return mavlink.MAVLink_param_request_read_message(*_ids(target), data, param_index=-1)


@dataclass(frozen=True, slots=True)
class Heartbeat(Outgoing):
    """Our HEARTBEAT; `vehicle_type` is a MAV_TYPE, `system_status` a MAV_STATE."""

    vehicle_type: int
    system_status: int = 4  # active
    custom_mode: int = 0

    def encode(self, target: Target | None) -> Message:
        return mavlink.MAVLink_heartbeat_message(
            self.vehicle_type,
            mavlink.MAV_AUTOPILOT_INVALID,
            0,
            self.custom_mode,
            self.system_status,
            mavlink_version=3,
        )


@dataclass(frozen=True, slots=True)
class Timesync(Outgoing):
    """TIMESYNC. A request has tc1 = 0 and our stamp; a reply our time and the request's stamp."""

    tc1_ns: int
    ts1_ns: int

    def encode(self, target: Target | None) -> Message:
        return mavlink.MAVLink_timesync_message(self.tc1_ns, self.ts1_ns)


@dataclass(frozen=True, slots=True)
class StatusTextOut(Outgoing):
    """STATUSTEXT: one chunk of at most 50 bytes (see `texts.chunks`). `text_id` is 0 for a text
    that has only one chunk."""

    severity: int
    data: bytes
    text_id: int = 0
    chunk: int = 0

    def encode(self, target: Target | None) -> Message:
        return mavlink.MAVLink_statustext_message(
            self.severity, self.data, self.text_id, self.chunk
        )


@dataclass(frozen=True, slots=True)
class SolverRecord(Record):
    """Numbers of one decision or identification, logged as DEBUG_FLOAT_ARRAY: at most 58. NaN means
    that there is no value; a number beyond the range of a float32 becomes infinity."""

    time_s: float
    data: tuple[float, ...]
    array_id: int
    name: str

    def encode(self, target: Target | None) -> Message:
        kind = mavlink.MAVLink_debug_float_array_message
        capacity = _capacity(kind, "data", len(self.data))
        data = (v if not abs(v) > FLOAT32_MAX else math.copysign(math.inf, v) for v in self.data)
        return kind(
            _boot_ms(self.time_s) * 1000,
            self.name.encode("ascii", errors="replace")[:10],
            self.array_id,
            (*data, *(0.0,) * (capacity - len(self.data))),
        )


@dataclass(frozen=True, slots=True)
class ConfigurationRecord(Record):
    """One piece of the flight's configuration, inputs or events, logged as TUNNEL: at most 128
    bytes."""

    data: bytes
    payload_type: int

    def encode(self, target: Target | None) -> Message:
        kind = mavlink.MAVLink_tunnel_message
        capacity = _capacity(kind, "payload", len(self.data))
        padded = tuple(self.data.ljust(capacity, b"\0"))
        return kind(0, 0, self.payload_type, len(self.data), padded)


def _found(target: Target | None) -> Target:
    if target is None:
        raise ValueError("no vehicle has been found yet: there is no receiver for this message")
    return target


def _ids(target: Target | None) -> tuple[int, int]:
    """The fields target_system and target_component."""
    vehicle = _found(target)
    return vehicle.system_id, vehicle.component_id


def _boot_ms(time_s: float) -> int:
    if not (math.isfinite(time_s) and time_s >= 0.0):
        raise ValueError(f"vehicle time must be finite and not negative, not {time_s!r}")
    return round(time_s * 1e3) & 0xFFFFFFFF


def _finite(name: str, *values: float) -> None:
    for value in values:
        if not (math.isfinite(value) and abs(value) <= FLOAT32_MAX):
            raise ValueError(f"{name} must be finite, not {value!r}")


def _capacity(kind: Any, field: str, count: int) -> int:
    """Length of an array field. Raises ValueError if `count` values do not fit into it."""
    capacity: int = kind.array_lengths[kind.ordered_fieldnames.index(field)]
    if count > capacity:
        raise ValueError(f"{kind.msgname} holds {capacity} values, not {count}")
    return capacity
