"""The names of a flight: its phases, how it may end, and how long each wait may last."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum

from pydantic import Field

from offboard.documents.parameters import Parameters


class Phase(Enum):
    """In flight order; the last three end the flight."""

    CONNECT = "connect"
    HEALTH = "health"
    STREAM = "stream"
    ENGAGE = "engage"
    ARM = "arm"
    TAKEOFF = "takeoff"
    CLIMB = "climb"
    EXCITE = "excite"
    JOIN = "join"
    TRACK = "track"
    HOVER = "hover"
    LAND = "land"
    STAND_DOWN = "stand down"
    DISARMED = "disarmed"
    YIELDED = "yielded"
    FAILED = "failed"


# What a log holds for a phase; numbers are never given anew, so that old logs stay readable
PHASE_CODES: Mapping[Phase, int] = {
    Phase.CONNECT: 0,
    Phase.HEALTH: 1,
    Phase.STREAM: 2,
    Phase.ENGAGE: 3,
    Phase.ARM: 4,
    Phase.TAKEOFF: 5,
    Phase.CLIMB: 6,
    Phase.JOIN: 7,
    Phase.TRACK: 8,
    Phase.HOVER: 9,
    Phase.LAND: 10,
    Phase.DISARMED: 11,
    Phase.YIELDED: 12,
    Phase.FAILED: 13,
    Phase.EXCITE: 14,
    Phase.STAND_DOWN: 15,
}
ENDS = frozenset({Phase.DISARMED, Phase.YIELDED, Phase.FAILED})
BEFORE_FLIGHT = frozenset({Phase.CONNECT, Phase.HEALTH, Phase.STREAM, Phase.ENGAGE, Phase.ARM})
TRACKING = frozenset({Phase.CLIMB, Phase.EXCITE, Phase.JOIN, Phase.TRACK, Phase.HOVER})


class ExitCode:
    """The contract of every command."""

    FLOWN = 0
    REQUIREMENT_MISSED = 1
    USAGE = 2
    REFUSED = 3
    ABORTED = 4


class Limits(Parameters):
    """How long each wait may last, and what is not flown, or no further. SI; seconds of vehicle
    time, but `connect_s` and `silence_s` are wall time."""

    connect_s: float = Field(default=20.0, gt=0, le=600)
    health_s: float = Field(default=90.0, gt=0, le=600)
    stream_s: float = Field(default=1.0, ge=0.6, le=10)
    engage_s: float = Field(default=10.0, gt=0, le=60)
    arm_s: float = Field(default=15.0, gt=0, le=60)
    lift_off_s: float = Field(default=8.0, gt=0, le=30)
    late_s: float = Field(default=90.0, gt=0, le=600)  # at the start of the reference
    excite_s: float = Field(default=30.0, gt=5, le=600)
    land_s: float = Field(default=90.0, gt=0, le=600)
    disarm_s: float = Field(default=5.0, ge=2, le=60)
    silence_s: float = Field(default=1.0, ge=0.2, le=60)  # of everything: then a landing is asked
    blind_s: float = Field(default=0.5, ge=0.15, le=10)  # of position or attitude alone
    missed_decisions: int = Field(default=3, ge=1, le=100)  # one after the other
    begin_armed: bool = True  # false: a vehicle that somebody has armed already is refused
    position_error_m: float = Field(default=5.0, gt=0.1, le=100)
    tilt_rad: float = Field(default=1.3, gt=0.2, le=1.5)
