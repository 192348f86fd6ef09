"""The phase table: which condition leads from which phases to which. The first row that holds is
taken; `phase_machine` has what begins with a phase, `actions` what is sent in it.

`fly` goes once from the ground to the ground. A flight of the service waits in STANDBY until the
pilot engages it in the air, and hands back instead of landing when it is stopped; the service
begins the next one where it has ended.
"""

from __future__ import annotations

from functools import cache

from offboard.flight import flying, starting
from offboard.flight.phases import ENDS, FLYING, Phase, ServiceOptions
from offboard.flight.rows import SHOWS, Condition, Transition, lost, lost_armed
from offboard.flight.state import FlightState

SERVICE_ONLY = frozenset({Phase.STANDBY, Phase.PAUSE, Phase.HAND_BACK})


@cache
def table(service: ServiceOptions | None = None) -> tuple[Transition, ...]:
    """The phase table of the service with these options; without them that of `fly`."""
    phases = tuple(phase for phase in Phase if phase in FLYING)
    if service is None:
        phases = tuple(phase for phase in phases if phase not in SERVICE_ONLY)
        return (
            *starting.FLY_BEGINS,
            *starting.starting((Phase.HEALTH, *starting.STREAMING)),
            *starting.FLY_IS_READY,
            *flying.ends_early(phases, serves=False),
            *flying.TO_THE_END,
            *flying.AT_REST["land"],
        )
    return (
        *starting.SERVICE_WAITS,
        *starting.starting(starting.STREAMING),
        Transition((Phase.HAND_BACK,), flying.handed, Phase.YIELDED, SHOWS),
        *flying.ends_early(phases, serves=True),
        *flying.TO_THE_END,
        *flying.HAND_BACK_ENDS,
        *flying.REQUESTED,
        *flying.AT_REST[service.then],
    )


def next_row(flight: FlightState) -> Transition | None:
    """The first row of the flight's phase whose condition holds, or None to stay."""
    rows = _by_phase(flight.service).get(flight.phase, ())
    return next((row for row in rows if row.condition(flight)), None)


@cache
def _by_phase(service: ServiceOptions | None) -> dict[Phase, tuple[Transition, ...]]:
    rows = table(service)
    return {phase: tuple(row for row in rows if phase in row.phases) for phase in Phase}


# ---------------------------------------------------------------------- its documentation

_ASKED = {
    Phase.HAND_BACK: "hold",
    Phase.HOLD: "hold, then land",
    Phase.LAND: "land",
    Phase.STAND_DOWN: "to disarm: it stands on the ground",
}
_PILOT, _ON_GROUND = "nothing: a pilot or a failsafe has it", "nothing: it is disarmed"
_UNASKED: dict[Condition, str] = {
    lost: _PILOT,
    lost_armed: _PILOT,
    flying.disarmed: _ON_GROUND,
    flying.rebooted_disarmed: _ON_GROUND,
    flying.disarmed_elsewhere: _ON_GROUND,
    flying.landed: _ON_GROUND,
}
IN_THE_AIR = FLYING | {Phase.LAND}


def asked(row: Transition, source: Phase) -> str:
    """What is asked of the autopilot where `row` leaves the phase `source`, in the air; empty:
    nothing, and without a reason."""
    before = _ASKED.get(source)
    return (
        _ASKED.get(row.target)
        or _UNASKED.get(row.condition)
        or (f"{before}, in this phase" if before else "")
    )


def exits(service: ServiceOptions | None) -> list[tuple[Transition, Phase]]:
    """The rows that leave the air, or the phases that fly by setpoints for those that end it, with
    each phase that they leave."""
    leaving = ENDS | _ASKED.keys()
    rows = [row for row in table(service) if row.target in leaving]
    return [(row, phase) for row in rows for phase in row.phases if phase in IN_THE_AIR]


def markdown() -> str:
    """The table of all exits from the air, for the README of `flight/`."""
    lines = ["| condition | in the phases | then | asked of the autopilot |", "|---|---|---|---|"]
    sources: dict[tuple[str, str, str], set[Phase]] = {}
    for row, phase in (*exits(None), *exits(ServiceOptions(then="land"))):
        condition = row.condition.__name__.replace("_", " ")
        sources.setdefault((condition, row.target.value, asked(row, phase)), set()).add(phase)
    for (condition, target, request), phases in sources.items():
        names = ", ".join(phase.value for phase in Phase if phase in phases)
        within = "all that fly" if phases >= FLYING else names
        lines.append(f"| {condition} | {within} | {target} | {request} |")
    return "\n".join(lines)
