"""Phases of a flight, actions of the failsafe, exit codes and outcome, limits, and options of the
service."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import ClassVar, Literal

from pydantic import Field

from offboard.documents.parameters import Parameters


class Phase(Enum):
    """Phases in the order of a flight; the last three end it. STANDBY, PAUSE and HAND_BACK occur
    only in flights of the service. `code` is the number of a phase in logs. Never reuse a number:
    old logs must stay readable."""

    _value_: str
    code: int

    def __new__(cls, name: str, code: int) -> Phase:
        phase = object.__new__(cls)
        phase._value_, phase.code = name, code
        return phase

    CONNECT = "connect", 0  # waits for the HEARTBEAT of an autopilot
    HEALTH = "health", 1  # waits until the vehicle can be flown (`preflight`)
    STANDBY = "standby", 17  # waits for the pilot, or for a request to start
    STREAM = "stream", 2  # sends setpoints, which PX4 requires before OFFBOARD
    ENGAGE = "engage", 3  # requests the mode of setpoints: OFFBOARD or GUIDED
    ARM = "arm", 4  # requests arming
    TAKEOFF = "takeoff", 5  # increases the thrust, or requests the autopilot's own takeoff
    CLIMB = "climb", 6  # flies to the start of the reference
    EXCITE = "excite", 14  # flies small steps there, to identify the vehicle
    JOIN = "join", 7  # flies the run-in of the reference
    TRACK = "track", 8  # flies the reference at full speed; this part is scored
    PAUSE = "pause", 18  # stops on the reference
    HOVER = "hover", 9  # flies the run-out, and hovers at the end of the reference
    HAND_BACK = "hand back", 19  # requests hold, with which the flight ends
    HOLD = "hold", 16  # requests hold, with which the failsafe begins; land follows
    STAND_DOWN = "stand down", 15  # requests disarming on the ground
    LAND = "land", 10  # requests land
    DISARMED = "disarmed", 11  # has landed
    YIELDED = "yielded", 12  # someone else has the vehicle
    FAILED = "failed", 13  # was refused, or did not end with a landing


class Action(IntEnum):
    """What the failsafe does when a limit is exceeded in flight, from mild to severe."""

    FLY = 0
    LEVEL = 1  # a level setpoint has replaced the last decision; nothing else is done
    HOLD = 2  # hold is requested, after `Limits.hold_s` land
    LAND = 3  # land is requested


class Request(Enum):
    """What a ground station requests (see `transitions.obey`)."""

    NONE = "nothing"
    START = "start"
    PAUSE = "pause"
    CONTINUE = "continue"
    HAND_BACK = "hand back"


ENDS = frozenset({Phase.DISARMED, Phase.YIELDED, Phase.FAILED})
WAITING = frozenset({Phase.CONNECT, Phase.HEALTH, Phase.STANDBY})
BEFORE_FLIGHT = WAITING | {Phase.STREAM, Phase.ENGAGE, Phase.ARM}
# custom_mode in the HEARTBEAT of an `offboard` that controls a vehicle, or is taking control of it
CONTROLLING = frozenset(each.code for each in Phase if each not in WAITING | ENDS)
TRACKING = frozenset({Phase.CLIMB, Phase.EXCITE, Phase.JOIN, Phase.TRACK, Phase.PAUSE, Phase.HOVER})
MOVING = frozenset({Phase.JOIN, Phase.TRACK})  # along the reference
# phases that request the end of the flight. A person may reverse what other phases request
ENDING = frozenset({Phase.HAND_BACK, Phase.HOLD, Phase.STAND_DOWN, Phase.LAND})
# phases in which the failsafe judges
FLYING = TRACKING | {Phase.TAKEOFF, Phase.HAND_BACK, Phase.HOLD}
SERVICE_ONLY = frozenset({Phase.STANDBY, Phase.PAUSE, Phase.HAND_BACK})  # never in `fly`
OUTAGE_MAX_S = 300.0  # longest wait for a landing vehicle that is not heard
OPERATOR_STOP = "stop requested by the operator"
RESTS = "at rest"  # reason of the planned landing; with any other the flight ended early


class ExitCode:
    """Exit codes of every command."""

    FLOWN = 0
    REQUIREMENT_MISSED = 1
    USAGE = 2
    REFUSED = 3
    ABORTED = 4


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a flight ended: an exit code of `ExitCode`, and one sentence. `log_problem` says why its
    log is not complete; it is empty for a complete log."""

    exit_code: int
    sentence: str
    log_problem: str = ""


Anchor = Literal["here", "origin"]
Then = Literal["hold", "land", "repeat"]


@dataclass(frozen=True, slots=True)
class ServiceOptions:
    """How the service flies. `anchor`: where it places the reference of a flight that begins in the
    air: with its start where the vehicle stops (here), or relative to the takeoff point (origin).
    `then`: what it does at the end of the reference. `arms`: whether it may arm and take off on
    request."""

    anchor: Anchor = "here"
    then: Then = "hold"
    arms: bool = False


class Limits(Parameters):
    """Limits of a flight, in SI units. Seconds are link time (README.md), but `connect_s` and
    `silence_s` are host time (in lockstep simulated time), and `blind_s`, ages and delays are
    vehicle time. `failsafe` defines what happens when a
    limit is exceeded in flight. The class variables are not settings, because no vehicle, link or
    site needed another value."""

    stream_s: ClassVar[float] = 1.0  # PX4 requires setpoints for 0.5 s before OFFBOARD
    engage_s: ClassVar[float] = 10.0  # HEARTBEAT, at 1 Hz, may be the only report of the mode
    arm_s: ClassVar[float] = 15.0  # a refusal is followed by a new request: checks may still run
    lift_off_s: ClassVar[float] = 8.0  # setpoints ramp to hover thrust in less than 2 s
    disarm_s: ClassVar[float] = 5.0  # the request is repeated every second
    overdue_s: ClassVar[float] = 90.0  # from the planned end of the climb to the start: head wind
    excite_s: ClassVar[float] = 30.0  # three rounds of identification steps end within it
    hold_s: ClassVar[float] = 2.0  # from hold to land
    hand_back_s: ClassVar[float] = 3.0  # from the request for hold to the request for land
    blind_s: ClassVar[float] = 0.5  # without a new position, or without a new attitude
    prediction_error_m: ClassVar[float] = 2.0  # distance from the predicted position

    # on the ground
    connect_s: float = Field(default=20.0, gt=0, le=600)
    health_s: float = Field(default=90.0, gt=0, le=600)
    begin_armed: bool = True  # false: refuse a vehicle that is armed already
    begin_engaged: bool = False  # true: fly a vehicle that another controller has engaged
    begin_in_failsafe: bool = False  # true: take over a vehicle that its failsafe flies
    begin_with_other_sender: bool = False  # true: fly although another program controls it, too
    link_delay_s: float = Field(default=0.4, gt=0, le=2)  # telemetry and setpoint together
    link_jitter_s: float = Field(default=0.15, gt=0, le=2)  # standard deviation of the delay
    # in flight
    land_s: float = Field(default=90.0, gt=0, le=600)
    silence_s: float = Field(default=1.0, ge=0.2, le=60)  # no telemetry
    setpoint_age_s: float = Field(default=0.25, ge=0.1, le=2)  # of telemetry beyond link delay
    link_growth_s: float = Field(default=0.3, gt=0, le=2)  # of the link delay since takeoff
    missed_decisions: int = Field(default=3, ge=1, le=100)  # in a row
    position_error_m: float = Field(default=5.0, ge=0.1, le=100)
    gps_s: float = Field(default=1.0, ge=0.5, le=600)  # without the GPS fix or vision it had
    accuracy_m: float = Field(default=3.0, ge=0.5, le=100)  # of the position, by the vehicle
    position_jump_m: float = Field(default=2.0, ge=0.3, le=100)  # of the estimate, in 10 s
    hover_thrust: float = Field(default=0.9, ge=0.05, le=1)  # normalised thrust that hovers
    tilt_rad: float = Field(default=1.3, ge=0.2, le=1.5)
    tilt_error_rad: float = Field(default=0.5, ge=0.1, le=3.2)  # from every recent command
    ceiling_m: float = Field(default=120.0, gt=0, le=10000)  # above the takeoff point
    radius_m: float = Field(default=1000.0, gt=0, le=100000)  # from the takeoff point
    # remaining charge, 0 .. 1; with 1 the vehicle would land at once
    battery: float = Field(default=0.1, ge=0, le=0.9)
    log_lost: Literal["land", "go_on"] = "land"  # if the log cannot be written
