"""Values that firmware, autopilot and link exchange: results, texts, setpoints, modes, items.

Knows no firmware and no message builder.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Protocol

Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # w, x, y, z; FRD -> NED
NAN3: Triple = (math.nan, math.nan, math.nan)


class ParameterValues(Protocol):
    """Values of the parameters by name."""

    def __getitem__(self, name: str) -> float: ...


class Result(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    CANCELLED = 6


class Severity(IntEnum):
    """The values of MAV_SEVERITY that are used."""

    EMERGENCY = 0
    CRITICAL = 2
    WARNING = 4
    INFO = 6


@dataclass(frozen=True, slots=True)
class StatusText:
    """A STATUSTEXT."""

    severity: Severity
    text: str


def info(text: str) -> StatusText:
    return StatusText(Severity.INFO, text)


def warning(text: str) -> StatusText:
    return StatusText(Severity.WARNING, text)


def critical(text: str) -> StatusText:
    return StatusText(Severity.CRITICAL, text)


@dataclass(frozen=True, slots=True)
class AttitudeSetpoint:
    """SET_ATTITUDE_TARGET as the firmware reads it. Attitude and rates None: keep the attitude."""

    attitude: Quaternion | None
    rates_frd_radps: Triple | None
    thrust: float  # 0 .. 1
    climb_mps: float | None = None  # climb rate that replaces the thrust; None: `thrust` counts
    event: str = ""  # raised when the setpoint is taken, as a value should have been refused


@dataclass(frozen=True, slots=True)
class MotionSetpoint:
    """Position, velocity, acceleration (NED, SI), yaw, yaw rate; NaN where nothing is demanded."""

    position_ned_m: Triple = NAN3
    velocity_ned_mps: Triple = NAN3
    acceleration_ned_mps2: Triple = NAN3
    yaw_rad: float = math.nan
    yaw_rate_radps: float = math.nan
    faces_way: bool = False  # whether, without a yaw, the nose points in the direction of flight
    turn_radps: float = math.inf  # yaw rate limit
    turn_sense: float = 0.0  # > 0: turn to the yaw clockwise, < 0: counterclockwise, 0: shorter way


class Behaviour(Enum):
    """What the vehicle does in a mode; several modes may have the same behaviour."""

    HOLD = "holds position"
    TAKEOFF = "climbs to the takeoff height"
    LAND = "descends where it is and lands"
    RETURN = "flies home and lands"
    MISSION = "flies the mission"
    STICKS = "flies by sticks; descends slowly without stick input"
    LEVEL = "level attitude, least throttle: a manual mode with sticks down"
    COAST = "keeps the last demand: a manual mode without stick input"
    SETPOINT = "obeys setpoints"
    ORBIT = "flies the circle that a client requests"


@dataclass(frozen=True, slots=True)
class Circle:
    """A circle that a client requests."""

    centre_ned_m: Triple
    radius_m: float  # negative: anticlockwise
    speed_mps: float
    yaw_behaviour: int  # ORBIT_YAW_BEHAVIOUR


@dataclass(frozen=True, slots=True)
class Mode:
    """One flight mode."""

    name: str
    title: str  # name in STATUSTEXTs
    custom_mode: int
    base_mode: int  # MAV_MODE_FLAG without the armed bit
    behaviour: Behaviour
    arms: bool = True  # whether the vehicle may be armed in it
    remembered: bool = True  # whether the vehicle returns to it, for example after disarming
    needs_sticks: bool = False
    needs_position: bool = False


@dataclass(frozen=True, slots=True)
class Asked:
    """What a command requests: a mode by name, "arm" or "disarm". An empty name is a refusal with
    this result (None: no acknowledgement) and this text."""

    name: str = ""
    refusal: Result | None = None
    text: StatusText | None = None


@dataclass(frozen=True, slots=True)
class MissionItem:
    """A mission item as it was uploaded: x and y in 1e-7 deg, z in m, in `frame` (MAV_FRAME)."""

    frame: int
    command: int  # MAV_CMD
    params: tuple[float, float, float, float]
    x: int
    y: int
    z: float
