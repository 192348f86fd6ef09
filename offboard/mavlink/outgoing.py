"""What the flight asks to be sent: one frozen value per message, the twin of events.py.

NED, FRD, SI and vehicle time; conversion to the wire's units and frames happens in wire.py. The
last three values, the records, are for our own log and are never sent.
"""

from __future__ import annotations

from dataclasses import dataclass

from offboard.mavlink.events import Triple

FORCE_DISARM = 21196.0  # param2 of MAV_CMD_COMPONENT_ARM_DISARM: also in the air


@dataclass(frozen=True, slots=True)
class AttitudeTarget:
    """SET_ATTITUDE_TARGET, attitude and thrust.

    `thrust_mps2` is thrust per unit of mass, `thrust_direction_ned` the commanded third body axis
    (unit), `course_rad` the commanded heading. `hover_thrust` is the normalised thrust that holds
    the weight. `body_z_down` is the third component of the body's own third axis when the command
    acts, for autopilots which divide by it; None: the commanded one.
    """

    time_s: float
    thrust_mps2: float
    thrust_direction_ned: Triple
    course_rad: float
    hover_thrust: float
    gravity_mps2: float = 9.81
    body_z_down: float | None = None


@dataclass(frozen=True, slots=True)
class PositionTarget:
    """SET_POSITION_TARGET_LOCAL_NED; what is None is left to the autopilot."""

    time_s: float
    position_ned_m: Triple | None = None
    velocity_ned_mps: Triple | None = None
    acceleration_ned_mps2: Triple | None = None
    course_rad: float | None = None
    course_rate_radps: float | None = None


@dataclass(frozen=True, slots=True)
class CommandLong:
    """COMMAND_LONG. NaN in `parameters` means "not given", as MAVLink has it."""

    command: int
    parameters: tuple[float, ...] = ()  # up to seven; the rest is 0
    confirmation: int = 0

    @classmethod
    def arm(cls) -> CommandLong:
        return cls(400, (1.0,))

    @classmethod
    def disarm(cls, force: bool = False) -> CommandLong:
        """`force` disarms in the air too: the vehicle falls."""
        return cls(400, (0.0, FORCE_DISARM if force else 0.0))

    @classmethod
    def land(cls) -> CommandLong:
        return cls(21)

    @classmethod
    def return_to_launch(cls) -> CommandLong:
        return cls(20)

    @classmethod
    def message_interval(cls, message_id: int, rate_hz: float) -> CommandLong:
        """MAV_CMD_SET_MESSAGE_INTERVAL; the wire's interval is in whole microseconds."""
        return cls(511, (float(message_id), float(round(1e6 / rate_hz))))

    @classmethod
    def request_message(cls, message_id: int) -> CommandLong:
        return cls(512, (float(message_id),))


@dataclass(frozen=True, slots=True)
class ParamRead:
    """PARAM_REQUEST_READ by name, at most 16 characters."""

    name: str


@dataclass(frozen=True, slots=True)
class ParamSet:
    """PARAM_SET. An int sets an INT32 parameter, a float a REAL32 one."""

    name: str
    value: int | float


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """HEARTBEAT of ourselves; `vehicle_type` is a MAV_TYPE."""

    vehicle_type: int


@dataclass(frozen=True, slots=True)
class Timesync:
    """TIMESYNC. Answer: our time, and the asker's stamp unchanged; question: 0 and our stamp."""

    tc1_ns: int
    ts1_ns: int


@dataclass(frozen=True, slots=True)
class StatusTextOut:
    """STATUSTEXT, one chunk of at most 50 bytes (`texts.chunks` cuts longer ones); `text_id` 0:
    complete in itself."""

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
    course_rad: float
    course_rate_radps: float


@dataclass(frozen=True, slots=True)
class SolverRecord:
    """What a decision cost and is worth, logged as DEBUG_FLOAT_ARRAY: at most 58 numbers, which
    may be NaN where a controller has no such figure."""

    time_s: float
    data: tuple[float, ...]
    array_id: int = 0
    name: str = "pso"


@dataclass(frozen=True, slots=True)
class ConfigurationRecord:
    """One piece of what the flight was flown with, logged as TUNNEL: at most 128 bytes."""

    data: bytes
    payload_type: int


Outgoing = (
    AttitudeTarget
    | PositionTarget
    | CommandLong
    | ParamRead
    | ParamSet
    | Heartbeat
    | Timesync
    | StatusTextOut
    | ReferenceRecord
    | SolverRecord
    | ConfigurationRecord
)
Record = ReferenceRecord | SolverRecord | ConfigurationRecord
