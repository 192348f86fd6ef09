"""The phases of a flight as a table plus named guards. Facts in, the next phase out; no I/O.

`TABLE` is the whole state machine: a flight goes down the rows and the first row of its phase
whose guard holds is taken. What is done in a phase is the companion's business.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from pydantic import Field

from offboard.model.vehicle import Parameters


class Phase(Enum):
    """In flight order; the last three end the flight."""

    CONNECT = "connect"
    HEALTH = "health"
    STREAM = "stream"
    ENGAGE = "engage"
    ARM = "arm"
    TAKEOFF = "takeoff"
    CLIMB = "climb"
    JOIN = "join"
    TRACK = "track"
    HOVER = "hover"
    LAND = "land"
    DISARMED = "disarmed"
    YIELDED = "yielded"
    FAILED = "failed"


PHASES = tuple(Phase)
ENDS = frozenset({Phase.DISARMED, Phase.YIELDED, Phase.FAILED})
ON_GROUND = frozenset({Phase.CONNECT, Phase.HEALTH, Phase.STREAM, Phase.ENGAGE, Phase.ARM})
UNDER_CONTROL = frozenset({Phase.TAKEOFF, Phase.CLIMB, Phase.JOIN, Phase.TRACK, Phase.HOVER})


class ExitCode:
    """The contract of every command."""

    FLOWN = 0
    REQUIREMENT_MISSED = 1
    USAGE = 2
    REFUSED = 3
    ABORTED = 4


class Limits(Parameters):
    """How long each wait may last, and what is flown no further. Seconds of vehicle time (wall
    time before telemetry flows and for silence), SI."""

    connect_s: float = Field(default=20.0, gt=0, le=600)
    health_s: float = Field(default=90.0, gt=0, le=600)
    stream_s: float = Field(default=1.0, ge=0.6, le=10)
    engage_s: float = Field(default=10.0, gt=0, le=60)
    arm_s: float = Field(default=15.0, gt=0, le=60)
    lift_off_s: float = Field(default=8.0, gt=0, le=30)
    climb_s: float = Field(default=120.0, gt=0, le=600)
    land_s: float = Field(default=90.0, gt=0, le=600)
    silence_s: float = Field(default=1.0, ge=0.2, le=60)
    position_error_m: float = Field(default=5.0, gt=0.1, le=100)
    tilt_rad: float = Field(default=1.3, gt=0.2, le=1.5)


@dataclass(frozen=True, slots=True)
class Picture:
    """All facts that a guard may look at, at one moment. Times in seconds."""

    limits: Limits
    in_phase_s: float  # vehicle time since the phase began; wall time before telemetry flows
    silence_s: float  # wall time since anything was heard
    found: bool
    telemetry_ok: bool
    prearm_ok: bool
    configured: bool  # what the dialect must have set is set, or needs nothing
    engaged: bool
    armed: bool
    airborne: bool
    lifted_off: bool
    at_start: bool
    track_time_s: float
    track_start_s: float
    track_end_s: float
    rest_time_s: float
    position_error_m: float
    tilt_rad: float
    stop_requested: bool
    controller_failed: bool


Guard = Callable[[Picture], bool]


def vehicle_found(now: Picture) -> bool:
    return now.found


def healthy(now: Picture) -> bool:
    return now.telemetry_ok and now.configured and (now.prearm_ok or now.armed)


def streamed(now: Picture) -> bool:
    return now.in_phase_s >= now.limits.stream_s


def engaged(now: Picture) -> bool:
    return now.engaged


def armed(now: Picture) -> bool:
    return now.armed and now.engaged


def lifted_off(now: Picture) -> bool:
    return now.lifted_off


def at_start(now: Picture) -> bool:
    return now.at_start


def at_full_speed(now: Picture) -> bool:
    return now.track_time_s >= now.track_start_s


def track_over(now: Picture) -> bool:
    return now.track_time_s >= now.track_end_s


def at_rest(now: Picture) -> bool:
    return now.track_time_s >= now.rest_time_s


def disarmed(now: Picture) -> bool:
    return not now.armed


def disarmed_in_flight(now: Picture) -> bool:
    return not now.armed


def mode_taken(now: Picture) -> bool:
    return not now.engaged


def silent(now: Picture) -> bool:
    return now.silence_s > now.limits.silence_s


def lost_on_ground(now: Picture) -> bool:
    return now.silence_s > now.limits.connect_s


def stop_requested(now: Picture) -> bool:
    return now.stop_requested


def diverged(now: Picture) -> bool:
    return now.position_error_m > now.limits.position_error_m


def toppled(now: Picture) -> bool:
    return now.tilt_rad > now.limits.tilt_rad


def controller_failed(now: Picture) -> bool:
    return now.controller_failed


def longer_than(limit: str) -> Guard:
    """A guard that holds when the phase has lasted longer than the named limit."""

    def too_long(now: Picture) -> bool:
        return now.in_phase_s > float(getattr(now.limits, limit))

    too_long.__name__ = f"longer_than_{limit}"
    return too_long


@dataclass(frozen=True, slots=True)
class Row:
    """From `source`, when `guard` holds, to `target`; `exit_code` where the flight's result is
    decided by this row (kept by a landing that follows)."""

    source: Phase
    guard: Guard
    target: Phase
    reason: str
    exit_code: int | None = None


def _airborne_rows(source: Phase) -> tuple[Row, ...]:
    return (
        Row(source, mode_taken, Phase.YIELDED, "the vehicle left {mode_wanted} for {mode}", 4),
        Row(source, disarmed_in_flight, Phase.FAILED, "the vehicle disarmed in flight", 4),
        Row(source, silent, Phase.FAILED, "no telemetry for {silence_s:.1f} s; stream stopped", 4),
        Row(source, stop_requested, Phase.LAND, "stop requested by the operator", 4),
        Row(source, controller_failed, Phase.LAND, "the controller failed: {failure}", 4),
        Row(source, toppled, Phase.LAND, "tilt {tilt_deg:.0f} deg", 4),
    )


_DIVERGED = "{position_error_m:.1f} m from the reference (limit {position_error_limit_m:.1f} m)"


def _tracking_rows(source: Phase) -> tuple[Row, ...]:
    return (*_airborne_rows(source), Row(source, diverged, Phase.LAND, _DIVERGED, 4))


def _ground_rows(source: Phase) -> tuple[Row, ...]:
    return (
        Row(source, stop_requested, Phase.FAILED, "stopped by the operator before take-off", 4),
        Row(source, lost_on_ground, Phase.FAILED, "vehicle silent for {silence_s:.0f} s", 3),
    )


TABLE: tuple[Row, ...] = (
    Row(Phase.CONNECT, stop_requested, Phase.FAILED, "stopped by the operator", 4),
    Row(Phase.CONNECT, vehicle_found, Phase.HEALTH, "vehicle found"),
    Row(
        Phase.CONNECT,
        longer_than("connect_s"),
        Phase.FAILED,
        "no vehicle heard in {in_phase_s:.0f} s; is it running, and sending to this port?",
        3,
    ),
    *_ground_rows(Phase.HEALTH),
    Row(Phase.HEALTH, healthy, Phase.STREAM, "telemetry flows and the vehicle can arm"),
    Row(Phase.HEALTH, longer_than("health_s"), Phase.FAILED, "not ready: {unready}", 3),
    *_ground_rows(Phase.STREAM),
    Row(Phase.STREAM, streamed, Phase.ENGAGE, "setpoints stream"),
    *_ground_rows(Phase.ENGAGE),
    Row(Phase.ENGAGE, engaged, Phase.ARM, "the vehicle shows {mode}"),
    Row(
        Phase.ENGAGE,
        longer_than("engage_s"),
        Phase.FAILED,
        "the vehicle did not enter {mode_wanted} in {in_phase_s:.0f} s (it shows {mode})",
        3,
    ),
    *_ground_rows(Phase.ARM),
    Row(Phase.ARM, armed, Phase.TAKEOFF, "armed"),
    Row(Phase.ARM, mode_taken, Phase.FAILED, "the vehicle left {mode_wanted} for {mode}", 3),
    Row(
        Phase.ARM,
        longer_than("arm_s"),
        Phase.FAILED,
        "the vehicle did not arm in {in_phase_s:.0f} s",
        3,
    ),
    *_airborne_rows(Phase.TAKEOFF),
    Row(Phase.TAKEOFF, lifted_off, Phase.CLIMB, "lifted off"),
    Row(
        Phase.TAKEOFF,
        longer_than("lift_off_s"),
        Phase.LAND,
        "no lift-off in {in_phase_s:.0f} s; is hover_thrust in the vehicle file right?",
        4,
    ),
    *_tracking_rows(Phase.CLIMB),
    Row(Phase.CLIMB, at_start, Phase.JOIN, "hovers at the start of the reference"),
    Row(
        Phase.CLIMB,
        longer_than("climb_s"),
        Phase.LAND,
        "the start of the reference was not reached in {in_phase_s:.0f} s",
        4,
    ),
    *_tracking_rows(Phase.JOIN),
    Row(Phase.JOIN, at_full_speed, Phase.TRACK, "on the reference at full speed"),
    *_tracking_rows(Phase.TRACK),
    Row(Phase.TRACK, track_over, Phase.HOVER, "the reference was flown"),
    *_tracking_rows(Phase.HOVER),
    Row(Phase.HOVER, at_rest, Phase.LAND, "at rest"),
    Row(Phase.LAND, disarmed, Phase.DISARMED, "disarmed on the ground"),
    Row(Phase.LAND, silent, Phase.FAILED, "no telemetry for {silence_s:.1f} s while landing", 4),
    Row(
        Phase.LAND,
        longer_than("land_s"),
        Phase.FAILED,
        "not landed and disarmed after {in_phase_s:.0f} s",
        4,
    ),
)


def next_row(phase: Phase, now: Picture) -> Row | None:
    """The first row of `phase` whose guard holds, or None to stay."""
    return next((row for row in TABLE if row.source is phase and row.guard(now)), None)
