"""Phases of a flight, exit codes, and the limits of time and state."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Literal

from pydantic import Field

from offboard.documents.parameters import Parameters


class Phase(Enum):
    """In the order of a flight; the last three end it."""

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


# The number of a phase in logs. Never reuse a number: old logs must stay readable.
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
    """Exit codes of every command."""

    FLOWN = 0
    REQUIREMENT_MISSED = 1
    USAGE = 2
    REFUSED = 3
    ABORTED = 4


class Limits(Parameters):
    """Limits of a flight. SI; seconds of vehicle time, but `connect_s` and `silence_s` are wall
    time."""

    connect_s: float = Field(default=20.0, gt=0, le=600)
    health_s: float = Field(default=90.0, gt=0, le=600)
    stream_s: float = Field(default=1.0, ge=0.6, le=10)
    engage_s: float = Field(default=10.0, gt=0, le=60)
    arm_s: float = Field(default=15.0, gt=0, le=60)
    lift_off_s: float = Field(default=8.0, gt=0, le=30)
    late_s: float = Field(default=90.0, gt=0, le=600)  # after the planned end of the climb
    excite_s: float = Field(default=30.0, gt=5, le=600)
    land_s: float = Field(default=90.0, gt=0, le=600)
    disarm_s: float = Field(default=5.0, ge=2, le=60)
    silence_s: float = Field(default=1.0, ge=0.2, le=60)  # no telemetry: then land
    blind_s: float = Field(default=0.5, ge=0.15, le=10)  # no position, or no attitude: then land
    missed_decisions: int = Field(default=3, ge=1, le=100)  # in a row: then land
    log_lost: Literal["land", "go_on"] = "land"  # the log cannot be written
    begin_armed: bool = True  # false: refuse a vehicle that is armed already
    position_error_m: float = Field(default=5.0, gt=0.1, le=100)
    tilt_rad: float = Field(default=1.3, gt=0.2, le=1.5)
