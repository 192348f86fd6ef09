"""Programmes: what distinguishes a flight of `fly` from one of the service, as data.

Both use the same phases, guards and actions. `FLY` goes once from the ground to the ground. A
flight of the service waits in STANDBY until the pilot engages it in the air, and hands back instead
of landing when it is stopped; the service begins the next one where it has ended.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from offboard.flight import guards
from offboard.flight.facts import Facts
from offboard.flight.guards import Guard, longer_than, requested
from offboard.flight.phases import ENDS, FLYING, TRACKING, ExitCode, Phase
from offboard.flight.requests import Request
from offboard.flight.transitions import REBOOTED, TRANSITIONS, Row, flying_rows

Anchor = Literal["here", "origin"]
Then = Literal["hold", "land", "repeat"]


@dataclass(frozen=True, slots=True)
class Programme:
    """`rows` is the phase table. `anchor`: where the reference of a flight that begins in the air
    is placed, with its start where the vehicle stops (here) or relative to the take-off point.
    `serves`: it takes requests over MAVLink, and its flights begin where another has ended.
    `may_arm`: it may arm and take off on request."""

    rows: tuple[Row, ...] = TRANSITIONS
    anchor: Anchor = "origin"
    serves: bool = False
    may_arm: bool = True

    def next_row(self, phase: Phase, now: Facts) -> Row | None:
        """The first row of `phase` whose guard holds, or None to stay."""
        return next((row for row in self.rows if row.source is phase and row.guard(now)), None)


FLY = Programme()
STOPPABLE = (Phase.CLIMB, Phase.EXCITE, Phase.JOIN, Phase.TRACK, Phase.HOVER)
FLOWN = ExitCode.FLOWN
_WANTED_BACK = "handed back on request"
_ABANDONED = "{mode} in the air, and nobody flies the vehicle: a flight was cut short"
_UNFIT = "not engaged: {refusals}{not_ready}"
_TOO_SOON = "not engaged: {mode} again before a HEARTBEAT has shown another mode; switch again"
_WAITING_ROWS = (
    Row(Phase.CONNECT, guards.stop_requested, Phase.FAILED, "{stop}", FLOWN),
    Row(Phase.CONNECT, guards.vehicle_found, Phase.HEALTH, "vehicle found"),
    Row(Phase.HEALTH, guards.stop_requested, Phase.FAILED, "{stop}", FLOWN),
    Row(Phase.HEALTH, guards.abandoned, Phase.HAND_BACK, _ABANDONED, FLOWN),
    Row(Phase.HEALTH, guards.engaged_but_unfit, Phase.HAND_BACK, _UNFIT, ExitCode.REFUSED),
    Row(Phase.HEALTH, guards.usable, Phase.STANDBY, "telemetry flows"),
    Row(Phase.STANDBY, guards.rebooted, Phase.FAILED, REBOOTED, FLOWN),
    Row(Phase.STANDBY, guards.stop_requested, Phase.FAILED, "{stop}", FLOWN),
    Row(Phase.STANDBY, guards.abandoned, Phase.HAND_BACK, _ABANDONED, FLOWN),
    Row(Phase.STANDBY, guards.engaged_by_pilot, Phase.CLIMB, "engaged: {mode} in the air", FLOWN),
    Row(Phase.STANDBY, guards.engaged_but_unfit, Phase.HAND_BACK, _UNFIT, ExitCode.REFUSED),
    Row(Phase.STANDBY, guards.engaged_too_soon, Phase.HAND_BACK, _TOO_SOON, ExitCode.REFUSED),
    Row(Phase.STANDBY, guards.started_in_the_air, Phase.CLIMB, "start requested, {mode}", FLOWN),
    Row(Phase.STANDBY, guards.started_on_the_ground, Phase.STREAM, "start requested"),
)
_HAND_BACK_ROWS = (
    Row(Phase.HAND_BACK, guards.handed, Phase.YIELDED, "the vehicle shows {mode}"),
    *(
        row
        for row in flying_rows(Phase.HAND_BACK)
        if row.target is not Phase.HOLD and row.guard is not guards.stop_requested
    ),
    Row(
        Phase.HAND_BACK,
        longer_than("hand_back_s"),
        Phase.LAND,
        "the vehicle did not hold in {in_phase_s:.0f} s",
        ExitCode.ABORTED,
    ),
)
_REQUEST_ROWS = (
    *(
        Row(source, requested(Request.HAND_BACK), Phase.HAND_BACK, _WANTED_BACK, FLOWN)
        for source in (Phase.TAKEOFF, *STOPPABLE, Phase.PAUSE)
    ),
    *(
        Row(source, requested(Request.HAND_BACK), Phase.FAILED, "stopped on request", FLOWN)
        for source in (Phase.STREAM, Phase.ENGAGE)
    ),
    Row(Phase.ARM, requested(Request.HAND_BACK), Phase.STAND_DOWN, "stopped on request", FLOWN),
    *(
        Row(source, requested(Request.START), Phase.CLIMB, "start requested")
        for source in (Phase.EXCITE, Phase.JOIN, Phase.TRACK, Phase.PAUSE, Phase.HOVER)
    ),
    *(
        Row(source, requested(Request.PAUSE), Phase.PAUSE, "pause requested")
        for source in (Phase.JOIN, Phase.TRACK)
    ),
    Row(Phase.PAUSE, requested(Request.CONTINUE), Phase.TRACK, "continue requested"),
)
_THEN: dict[Then, tuple[Row, ...]] = {
    "hold": (),
    "land": (Row(Phase.HOVER, guards.at_rest, Phase.LAND, "at rest"),),
    "repeat": (Row(Phase.HOVER, guards.at_rest, Phase.CLIMB, "once more"),),
}


def service(then: Then, anchor: Anchor, *, arms: bool) -> Programme:
    """The programme of the service. `then`: what follows when the reference was flown."""
    kept = [
        _in_service(row)
        for row in (*TRANSITIONS, *flying_rows(Phase.PAUSE))
        if row.source not in (Phase.CONNECT, Phase.HEALTH) and row.guard is not guards.at_rest
    ]
    rows = (*_WAITING_ROWS, *_HAND_BACK_ROWS, *kept, *_REQUEST_ROWS, *_THEN[then])
    return Programme(rows, anchor, serves=True, may_arm=arms)


_ASKED = {Phase.HAND_BACK: "hold", Phase.HOLD: "hold, then land", Phase.LAND: "land"}
_PILOT, _ON_GROUND = "nothing: a pilot or a failsafe has it", "nothing: it is disarmed"
_UNASKED: dict[Guard, str] = {
    guards.lost: _PILOT,
    guards.lost_armed: _PILOT,
    guards.disarmed: _ON_GROUND,
    guards.rebooted_disarmed: _ON_GROUND,
    guards.disarmed_elsewhere: _ON_GROUND,
    guards.landed: _ON_GROUND,
}
IN_THE_AIR = FLYING | {Phase.LAND}


def asked(row: Row) -> str:
    """What is asked of the autopilot where `row` leaves a phase in the air; empty: nothing, and
    without a reason."""
    before = _ASKED.get(row.source)
    return (
        _ASKED.get(row.target)
        or _UNASKED.get(row.guard)
        or (f"{before}, in this phase" if before else "")
    )


def exits(programme: Programme) -> list[Row]:
    """The rows that leave the air, or the phases that fly by setpoints for those that end it."""
    leaving = ENDS | _ASKED.keys()
    return [row for row in programme.rows if row.source in IN_THE_AIR and row.target in leaving]


def markdown() -> str:
    """The table of all exits from the air, for the README of `flight/`."""
    lines = ["| condition | in the phases | then | asked of the autopilot |", "|---|---|---|---|"]
    sources: dict[tuple[str, str, str], list[str]] = {}
    for row in dict.fromkeys((*exits(FLY), *exits(service("land", "here", arms=True)))):
        condition = row.guard.__name__.replace("_", " ")
        phases = sources.setdefault((condition, row.target.value, asked(row)), [])
        if row.source.value not in phases:
            phases.append(row.source.value)
    every = [phase.value for phase in Phase if phase in FLYING]
    for (condition, target, request), phases in sources.items():
        within = "all that fly" if set(phases) >= set(every) else ", ".join(phases)
        lines.append(f"| {condition} | {within} | {target} | {request} |")
    return "\n".join(lines)


def _in_service(row: Row) -> Row:
    """A stop hands back where `fly` lands; a pilot who takes the vehicle is the usual end."""
    if row.guard is guards.stop_requested and row.source in TRACKING:
        return replace(row, target=Phase.HAND_BACK, exit_code=FLOWN)
    if row.guard is guards.lost and row.source in TRACKING:
        return replace(row, exit_code=FLOWN)
    return row
