"""Phases of a flight, actions of the failsafe, exit codes and outcome, limits, and options of the
service."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import ClassVar, Literal

from pydantic import Field

from offboard.documents.parameters import Parameters


class Phase(Enum):
    """In the order of a flight; the last three end it. STANDBY, PAUSE and HAND_BACK occur in
    flights of the service alone. Beside its name a phase has its number in logs: never reuse one,
    old logs must stay readable."""

    _value_: str
    code: int

    def __new__(cls, name: str, code: int) -> Phase:
        phase = object.__new__(cls)
        phase._value_, phase.code = name, code
        return phase

    CONNECT = "connect", 0
    HEALTH = "health", 1
    STANDBY = "standby", 17
    STREAM = "stream", 2
    ENGAGE = "engage", 3
    ARM = "arm", 4
    TAKEOFF = "takeoff", 5
    CLIMB = "climb", 6
    EXCITE = "excite", 14
    JOIN = "join", 7
    TRACK = "track", 8
    PAUSE = "pause", 18
    HOVER = "hover", 9
    HAND_BACK = "hand back", 19
    HOLD = "hold", 16
    STAND_DOWN = "stand down", 15
    LAND = "land", 10
    DISARMED = "disarmed", 11
    YIELDED = "yielded", 12
    FAILED = "failed", 13


class Action(IntEnum):
    """What follows when a limit is exceeded in flight, from mild to severe (see `failsafe`)."""

    FLY = 0
    LEVEL = 1  # shows that the last decision was replaced by level flight; asks for nothing
    HOLD = 2  # the autopilot is asked to hold, after `Limits.hold_s` to land
    LAND = 3  # the autopilot is asked to land


class Request(Enum):
    """What a ground station asks for (see `transitions.obey`)."""

    NONE = "nothing"
    START = "start"
    PAUSE = "pause"
    CONTINUE = "continue"
    HAND_BACK = "hand back"


ENDS = frozenset({Phase.DISARMED, Phase.YIELDED, Phase.FAILED})
WAITING = frozenset({Phase.CONNECT, Phase.HEALTH, Phase.STANDBY})
BEFORE_FLIGHT = WAITING | {Phase.STREAM, Phase.ENGAGE, Phase.ARM}
# codes of the phases in which an `offboard` has or takes the vehicle, in its HEARTBEAT
CONTROLLING = frozenset(each.code for each in Phase if each not in WAITING | ENDS)
TRACKING = frozenset({Phase.CLIMB, Phase.EXCITE, Phase.JOIN, Phase.TRACK, Phase.PAUSE, Phase.HOVER})
MOVING = frozenset({Phase.JOIN, Phase.TRACK})  # along the reference
# phases in which the failsafe judges
FLYING = TRACKING | {Phase.TAKEOFF, Phase.HAND_BACK, Phase.HOLD}
SERVICE_ONLY = frozenset({Phase.STANDBY, Phase.PAUSE, Phase.HAND_BACK})  # never in `fly`
OUTAGE_MAX_S = 300.0  # so long a vehicle that was asked to land, and is not heard, is waited for
OPERATOR_STOP = "stop requested by the operator"
RESTS = "at rest"  # why a landing begins that is no early end


class ExitCode:
    """Exit codes of every command."""

    FLOWN = 0
    REQUIREMENT_MISSED = 1
    USAGE = 2
    REFUSED = 3
    ABORTED = 4


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a flight ended: an exit code of `ExitCode`, and one sentence. `log_problem`: what of its
    log is lost; empty if nothing is."""

    exit_code: int
    sentence: str
    log_problem: str = ""


Anchor = Literal["here", "origin"]
Then = Literal["hold", "land", "repeat"]


@dataclass(frozen=True, slots=True)
class ServiceOptions:
    """How the service flies. `anchor`: where the reference of a flight that begins in the air is
    placed: its start where the vehicle stops (here), or relative to the take-off point (origin).
    `then`: what follows when the reference was flown. `arms`: it may arm and take off on request.
    """

    anchor: Anchor = "here"
    then: Then = "hold"
    arms: bool = False


class Limits(Parameters):
    """Limits of a flight. SI; seconds of vehicle time, but `connect_s` and `silence_s` are wall
    time, in lockstep simulated time. `failsafe` has what follows when one is exceeded in flight.
    The class variables are no settings: no vehicle, link or site needed another value."""

    stream_s: ClassVar[float] = 1.0  # PX4 wants setpoints for 0.5 s before OFFBOARD
    engage_s: ClassVar[float] = 10.0  # HEARTBEAT, at 1 Hz, may be the only report of the mode
    arm_s: ClassVar[float] = 15.0  # refusals are asked again: checks may still be running
    lift_off_s: ClassVar[float] = 8.0  # setpoints ramp to hover thrust in less than 2 s
    disarm_s: ClassVar[float] = 5.0  # asked for again each second
    overdue_s: ClassVar[float] = 90.0  # at the start, after the planned end of the climb: head wind
    excite_s: ClassVar[float] = 30.0  # three rounds of identification steps end within it
    hold_s: ClassVar[float] = 2.0  # from hold to land
    hand_back_s: ClassVar[float] = 3.0  # from the request to hold, to land
    blind_s: ClassVar[float] = 0.5  # no position, or no attitude
    prediction_error_m: ClassVar[float] = 2.0  # of the decision before

    # on the ground
    connect_s: float = Field(default=20.0, gt=0, le=600)
    health_s: float = Field(default=90.0, gt=0, le=600)
    begin_armed: bool = True  # false: refuse a vehicle that is armed already
    begin_engaged: bool = False  # true: fly one that another controller has in the mode already
    begin_in_failsafe: bool = False  # true: take one over from its failsafe
    begin_with_other_sender: bool = False  # true: fly although another program controls it, too
    link_delay_s: float = Field(default=0.4, gt=0, le=2)  # telemetry and setpoint together
    link_jitter_s: float = Field(default=0.15, gt=0, le=2)  # standard deviation of the delay
    # in flight
    land_s: float = Field(default=90.0, gt=0, le=600)
    silence_s: float = Field(default=1.0, ge=0.2, le=60)  # no telemetry
    setpoint_age_s: float = Field(default=0.25, ge=0.1, le=2)  # of telemetry beyond link delay
    link_growth_s: float = Field(default=0.3, gt=0, le=2)  # of the link's delay since take-off
    missed_decisions: int = Field(default=3, ge=1, le=100)  # in a row
    position_error_m: float = Field(default=5.0, ge=0.1, le=100)
    gps_s: float = Field(default=1.0, ge=0.5, le=600)  # without the fix of the take-off
    accuracy_m: float = Field(default=3.0, ge=0.5, le=100)  # of the position, as the vehicle says
    position_jump_m: float = Field(default=2.0, ge=0.3, le=100)  # of the estimate, in 10 s
    hover_thrust: float = Field(default=0.9, ge=0.05, le=1)  # normalised thrust that hovers
    tilt_rad: float = Field(default=1.3, ge=0.2, le=1.5)
    tilt_error_rad: float = Field(default=0.5, ge=0.1, le=3.2)  # from every recent command
    ceiling_m: float = Field(default=120.0, gt=0, le=10000)  # above the take-off point
    radius_m: float = Field(default=1000.0, gt=0, le=100000)  # from the take-off point
    # remaining charge, 0 .. 1; with 1 the vehicle would land at once
    battery: float = Field(default=0.1, ge=0, le=0.9)
    log_lost: Literal["land", "go_on"] = "land"  # the log cannot be written
