"""What the flight sends or records: one frozen value per message, the counterpart of events.py.

NED, FRD, SI and vehicle time; encode.py converts to the units and frames of MAVLink. The last three
values, the records, are written to the flight log and never sent.
"""

from __future__ import annotations

from dataclasses import dataclass

from offboard.mavlink.events import Triple


@dataclass(frozen=True, slots=True)
class AttitudeTarget:
    """SET_ATTITUDE_TARGET, attitude and thrust.

    `thrust_mps2` is thrust per unit of mass, `thrust_direction_ned` the commanded third body axis
    (unit), `heading_rad` the commanded heading. `hover_thrust` is the normalised thrust that holds
    the weight. `body_z_down` is the third component of the body's own third axis when the command
    acts, for autopilots that divide by it; None: that of `thrust_direction_ned`.
    """

    time_s: float
    thrust_mps2: float
    thrust_direction_ned: Triple
    heading_rad: float
    hover_thrust: float
    gravity_mps2: float = 9.81
    body_z_down: float | None = None


@dataclass(frozen=True, slots=True)
class PositionTarget:
    """SET_POSITION_TARGET_LOCAL_NED with all fields in use."""

    time_s: float
    position_ned_m: Triple
    velocity_ned_mps: Triple
    acceleration_ned_mps2: Triple
    heading_rad: float
    heading_rate_radps: float


@dataclass(frozen=True, slots=True)
class CommandLong:
    """COMMAND_LONG. NaN in `parameters` means "not given", as in MAVLink."""

    command: int
    parameters: tuple[float, ...] = ()  # up to seven; the rest is 0
    confirmation: int = 0

    @classmethod
    def arm(cls) -> CommandLong:
        return cls(400, (1.0,))

    @classmethod
    def disarm(cls) -> CommandLong:
        """Refused by an autopilot whose own land detector says that it flies."""
        return cls(400, (0.0,))

    @classmethod
    def land(cls) -> CommandLong:
        return cls(21)

    @classmethod
    def message(cls, message_id: int) -> CommandLong:
        """MAV_CMD_REQUEST_MESSAGE, once."""
        return cls(512, (float(message_id),))

    @classmethod
    def run_prearm_checks(cls) -> CommandLong:
        """MAV_CMD_RUN_PREARM_CHECKS: the vehicle reports what fails by STATUSTEXT."""
        return cls(401)

    @classmethod
    def message_interval(cls, message_id: int, rate_hz: float) -> CommandLong:
        """MAV_CMD_SET_MESSAGE_INTERVAL; the interval is in whole microseconds."""
        return cls(511, (float(message_id), float(round(1e6 / rate_hz))))


@dataclass(frozen=True, slots=True)
class CommandResult:
    """COMMAND_ACK of a command that was sent to us; `result` is a MAV_RESULT."""

    command: int
    result: int
    system_id: int  # of its sender, as is the component
    component_id: int


@dataclass(frozen=True, slots=True)
class ParamRead:
    """PARAM_REQUEST_READ by name, at most 16 characters."""

    name: str


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """Our HEARTBEAT; `vehicle_type` is a MAV_TYPE, `system_status` a MAV_STATE."""

    vehicle_type: int
    system_status: int = 4  # active
    custom_mode: int = 0


@dataclass(frozen=True, slots=True)
class Timesync:
    """TIMESYNC. Request: tc1 = 0 and our stamp. Reply: our time and the stamp of the request."""

    tc1_ns: int
    ts1_ns: int


@dataclass(frozen=True, slots=True)
class StatusTextOut:
    """STATUSTEXT, one chunk of at most 50 bytes (see `texts.chunks`); `text_id` 0: a text of one
    chunk."""

    severity: int
    data: bytes
    text_id: int = 0
    chunk: int = 0


@dataclass(frozen=True, slots=True)
class ReferenceRecord:
    """The reference at a tick, logged as POSITION_TARGET_LOCAL_NED."""

    time_s: float
    position_ned_m: Triple
    velocity_ned_mps: Triple
    acceleration_ned_mps2: Triple
    heading_rad: float
    heading_rate_radps: float


@dataclass(frozen=True, slots=True)
class SolverRecord:
    """Numbers of one decision or identification, logged as DEBUG_FLOAT_ARRAY: at most 58, NaN
    where there is none."""

    time_s: float
    data: tuple[float, ...]
    array_id: int = 0
    name: str = "pso"


@dataclass(frozen=True, slots=True)
class ConfigurationRecord:
    """One piece of the flight's configuration or of its inputs, logged as TUNNEL: at most 128
    bytes."""

    data: bytes
    payload_type: int


Outgoing = (
    AttitudeTarget
    | PositionTarget
    | CommandLong
    | CommandResult
    | ParamRead
    | Heartbeat
    | Timesync
    | StatusTextOut
    | ReferenceRecord
    | SolverRecord
    | ConfigurationRecord
)
Record = ReferenceRecord | SolverRecord | ConfigurationRecord
