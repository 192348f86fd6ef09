"""The phase table and its application: the first row of the present phase whose condition holds is
taken, and the flight enters its target. `starting` and `flying` have the rows; `actions` defines
what is sent in a phase.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping
from functools import cache

import numpy as np

from offboard.flight import decision, failsafe, flying, outbox, starting
from offboard.flight.conditions import REBOOTED, Transition, in_own_failsafe
from offboard.flight.ground_contact import Touchdown
from offboard.flight.phases import (
    BEFORE_FLIGHT,
    FLYING,
    TRACKING,
    WAITING,
    ExitCode,
    Outcome,
    Phase,
    Request,
    ServiceOptions,
)
from offboard.flight.preflight import ParameterReading
from offboard.flight.state import FlightState
from offboard.identification.learner import Learner, Stage
from offboard.mavlink.events import LocalPosition

DIFFERENT = 0.1  # relative error of the hover thrust; a smaller one is left to the observer
REFUSALS_EVERY_S = 1.0  # interval between announcements of a refused request
RAISED_M = 0.05  # a reference that is raised by less is not announced
SETTLED = 0.02  # as DIFFERENT, for a vehicle that its own autopilot has flown for long
TAKEN = "a failsafe of the vehicle has it, as its HEARTBEAT shows"
STAGES = {
    Phase.CLIMB: Stage.CLIMB,
    Phase.EXCITE: Stage.STEPS,
    Phase.JOIN: Stage.MOTION,
    Phase.TRACK: Stage.MOTION,
}  # of the identification
PROCEEDS = BEFORE_FLIGHT | TRACKING | {Phase.TAKEOFF}  # phases of a flight that goes on


@cache
def table(service: ServiceOptions | None = None) -> tuple[Transition, ...]:
    """Return the phase table of the service with these options; without options, that of `fly`."""
    serves = service is not None
    rows = (
        *(starting.SERVICE_BEGINS if serves else starting.FLY_BEGINS),
        *starting.STARTING,
        *flying.ends_early(serves=serves),
        *(flying.SERVICE_ENDS if serves else ()),
        *flying.TO_THE_END,
        *flying.AT_REST[service.then if service else "land"],
    )
    return tuple(row for row in rows if row.phases)


def next_row(flight: FlightState) -> Transition | None:
    """Return the first row of the flight's phase whose condition holds, or None to stay in it."""
    rows = _by_phase(flight.service)[flight.phase]
    return next((row for row in rows if row.condition(flight)), None)


@cache
def _by_phase(service: ServiceOptions | None) -> dict[Phase, tuple[Transition, ...]]:
    rows = table(service)
    return {phase: tuple(row for row in rows if phase in row.phases) for phase in Phase}


# ---------------------------------------------------------------------- its application


def advance(flight: FlightState) -> None:
    """Take rows until no condition of the present phase holds, or the flight has ended."""
    while not flight.in_end_phase:
        if flight.phase in FLYING:
            failsafe.judge(flight)
        _note_spoiled(flight)
        row = next_row(flight)
        if row is None:
            break
        _enter(flight, row)


def obey(flight: FlightState, request: Request, sender: str) -> bool:
    """Obey a request of a ground station: take the row whose condition holds with it, after all
    transitions that are due without it. Returns whether there is such a row, or the flight obeys
    the request already. The reason of a refusal is announced, but at most once a second, because a
    ground station may repeat its request."""
    advance(flight)
    flight.request = request
    row = next_row(flight)
    obeyed = row is not None or request is flight.obeyed
    sentence = f"{request.value} requested by {sender}"
    if row is not None:
        outbox.announce(flight, sentence)
        _enter(flight, row)
        flight.obeyed = request
    elif not obeyed and flight.now_s - flight.refused_s >= REFUSALS_EVERY_S:
        starts = request is Request.START and flight.phase in WAITING
        why = starting.not_started(flight) if starts else f"not in the phase {flight.phase.value}"
        outbox.announce(flight, f"refused: {sentence}, but {why}")
        flight.refused_s = flight.now_s
    flight.request = Request.NONE
    return obeyed


def _note_spoiled(flight: FlightState) -> None:
    """Record as the outcome that a landing was interrupted by the vehicle's own failsafe or by a
    reboot. The announcement tells it to the score."""
    if flight.phase is not Phase.LAND or flight.outcome is not None:
        return
    if in_own_failsafe(flight):
        sentence, cause = f"the vehicle's own failsafe flew it, in {flight.vehicle.mode}", "link"
    elif flight.rebooted:
        sentence, cause = f"{REBOOTED} while landing", "restart"
    else:
        return
    outbox.announce_phase(flight, sentence, cause)
    flight.outcome = Outcome(ExitCode.ABORTED, sentence + _explanation(flight))


def name_failsafe(flight: FlightState) -> None:
    """Announce that a failsafe, and not a pilot, has taken the vehicle, if the newest HEARTBEAT
    shows it."""
    before = flight.outcome
    if flight.taken and flight.vehicle.in_failsafe and before is not None:
        sentence = TAKEN + _explanation(flight)
        outbox.announce(flight, sentence, once=True)
        flight.outcome = Outcome(before.exit_code, f"{before.sentence}; {sentence}")


def _enter(flight: FlightState, row: Transition) -> None:
    """End the present phase, and begin the target of `row`."""
    source, reason, cause = flight.phase, row.why(flight), row.cause.format(flight=flight)
    _conclude(flight, row, reason)
    flight.vehicle.clear_messages()
    flight.requested_s.clear()
    if flight.request is Request.NONE and row.target not in PROCEEDS:
        flight.obeyed = Request.NONE  # the flight ends for another reason
    flight.phase = row.target
    flight.began_s = flight.now_s
    outbox.announce_phase(flight, reason, cause)
    if source in BEFORE_FLIGHT and row.target in FLYING:
        _begin_to_fly(flight, source)
    if flight.identification:
        stage = STAGES.get(row.target, Stage.OTHER)
        flight.identification.on_stage(stage, flight.time_s)
    if row.target in BEGINS:
        BEGINS[row.target](flight, source)


def _conclude(flight: FlightState, row: Transition, reason: str) -> None:
    """Update the outcome: the most severe exit code counts, and later reasons are added to the
    first sentence."""
    if row.exit_code is not None:
        if flight.outcome is None:
            said = _explanation(flight)
            sentence = reason if said in reason else reason + said
            flight.outcome = Outcome(row.exit_code, sentence)
        else:
            sentence = f"{flight.outcome.sentence}; {reason}"
            flight.outcome = Outcome(max(flight.outcome.exit_code, row.exit_code), sentence)
    elif row.target is Phase.DISARMED and flight.outcome is None:
        flight.outcome = Outcome(ExitCode.FLOWN, "flown and landed")


def _explanation(flight: FlightState) -> str:
    dialect, vehicle = flight.dialect, flight.vehicle
    if dialect is None:
        return vehicle.explanation("")
    fix = dialect.remedy(vehicle.texts)
    return vehicle.explanation(dialect.unsaid) + (fix and f". Fix: {fix}")


def _begin_to_fly(flight: FlightState, source: Phase) -> None:
    """Note what is known about vehicle and link when the first phase in flight begins."""
    flight.authority.ask()  # it may show the mode already
    flight.clock.settle()
    rates_hz = flight.session.telemetry.rates_hz
    flight.positioning.begin(flight.vehicle, rates_hz, flight.known_dialect.estimator_message)
    if flight.identification:
        flight.identification.on_link_delay(flight.clock.delay)
        if limits := shown_limits(flight, flight.identification):
            flight.model = flight.model.model_copy(update=limits)
            flight.identification.on_shown(limits)
    if source is Phase.ARM:  # on the ground, where the time that this takes does no harm
        decision.begin(flight)


def _begin_health(flight: FlightState, source: Phase) -> None:
    """Forget the parameters: it may be another vehicle, or have other parameters."""
    flight.vehicle.parameters.clear()
    flight.reading = ParameterReading()


def _begin_stream(flight: FlightState, source: Phase) -> None:
    if not flight.in_engage_mode:  # else it may still enter hold, as requested in HEALTH
        flight.authority.ask()  # from now on another mode is a pilot's
    _set_hover_thrust(flight)


def _begin_takeoff(flight: FlightState, source: Phase) -> None:
    position = flight.vehicle.position
    assert position is not None
    flight.home_ned_m, flight.took_off = flight.jumps.without(position.position_ned_m), True
    if flight.takes_off_by_command:  # a level setpoint would cancel it
        flight.setpoint_s = math.inf


def _begin_join(flight: FlightState, source: Phase) -> None:
    # the greatest: before a later start the vehicle may have come to stand on something
    shown = flight.observer.hover_thrust_estimate
    flight.start_hover_thrust = float(np.fmax(shown, flight.start_hover_thrust))
    flight.plan.start_track(flight.time_s)


def _begin_pause(flight: FlightState, source: Phase) -> None:
    flight.plan.pause(flight.time_s)


def _begin_track(flight: FlightState, source: Phase) -> None:
    if source is Phase.PAUSE:
        flight.plan.resume(flight.time_s)


def _begin_hand_back(flight: FlightState, source: Phase) -> None:
    flight.returns_to = flight.authority.engaged_from if source is Phase.HAND_BACK else ""


def _begin_land(flight: FlightState, source: Phase) -> None:
    flight.touchdown = Touchdown(flight.home_ned_m if flight.took_off else None)


def _begin_climb(flight: FlightState, source: Phase) -> None:
    """Plan the climb to the start of the reference: after takeoff, after the pilot has engaged in
    the air, or for one more flight of the reference."""
    position = flight.vehicle.position
    assert position is not None
    flown = flight.plan.sample(flight.time_s)
    if flown is not None:  # begin at the reference, because the vehicle follows it
        heading_rad = float(flown.heading_rad)
        flight.plan.start_climb(
            flight.time_s, flown.position_ned_m, flown.velocity_ned_mps, heading_rad
        )
        return
    in_the_air = source is not Phase.TAKEOFF
    if in_the_air:
        _place_reference(flight, position)
    else:
        flight.plan.origin_ned_m = flight.jumps.reported(flight.home_ned_m)
    if in_the_air or flight.takes_off_by_command:
        _set_hover_thrust(flight, SETTLED if source is Phase.STANDBY else DIFFERENT)
    flight.observer.freeze(False)
    decision.begin(flight)
    flight.plan.start_climb(
        flight.time_s,
        np.array(position.position_ned_m),
        np.array(position.velocity_ned_mps),
        flight.vehicle.heading_rad,
    )


BEGINS: Mapping[Phase, Callable[[FlightState, Phase], None]] = {
    Phase.HEALTH: _begin_health,
    Phase.STREAM: _begin_stream,
    Phase.ENGAGE: lambda flight, _: flight.authority.ask(),  # it may show the mode already
    Phase.TAKEOFF: _begin_takeoff,
    Phase.CLIMB: _begin_climb,
    Phase.JOIN: _begin_join,
    Phase.PAUSE: _begin_pause,
    Phase.TRACK: _begin_track,
    Phase.HAND_BACK: _begin_hand_back,
    Phase.LAND: _begin_land,
}
"""What begins with a phase: a function of the flight and of the phase before."""


def _place_reference(flight: FlightState, position: LocalPosition) -> None:
    """Place the reference of a vehicle that was found in the air. `home_ned_m` becomes the place
    where it last rested or, if that was not seen, the point below it at the height of the local
    origin. With the anchor "here" the reference starts where the vehicle stops; with "origin" it is
    relative to the last rest, and in `fly` to the point below the vehicle."""
    contact, jumps = flight.contact, flight.jumps
    place_ned_m = jumps.without(position.position_ned_m)
    flight.home_ned_m = flight.last_rest_ned_m(place_ned_m)
    below = (*place_ned_m[:2], contact.rest_down_m)
    rest = contact.rest_ned_m and jumps.reported(contact.rest_ned_m)
    if flight.service and flight.service.anchor == "here":
        above_m = flight.plan.place_start(
            position.position_ned_m, position.velocity_ned_mps, rest[2] if rest else None
        )
        if above_m >= RAISED_M:
            outbox.announce(
                flight,
                f"the reference starts {above_m:.1f} m higher: from here it would "
                + ("touch the ground" if rest else "go lower, and the ground is not known"),
            )
    else:
        from_rest = rest if flight.service else None
        flight.plan.origin_ned_m = from_rest or jumps.reported(below)


def shown_limits(flight: FlightState, learner: Learner) -> dict[str, tuple[float, ...]]:
    """Return the limits of angular acceleration and angular rate by their names in `Vehicle`: for
    roll and pitch the lower of the vehicle file and the autopilot's parameters, for yaw that of the
    vehicle file. A limit for which no parameter was read is left out."""
    read, shown = flight.vehicle.parameters, defaultdict[str, list[float]](list)
    for name, (limit, unit) in flight.dialect.tilting_parameters.items() if flight.dialect else ():
        if name in read:
            shown[limit].append(read[name] * unit if read[name] > 0.0 else math.inf)
    limits = {}
    for limit, values in shown.items():
        *tilt, yaw = getattr(learner.file, limit)
        limits[limit] = (*(min(each, *values) for each in tilt), yaw)
    return limits


def _set_hover_thrust(flight: FlightState, least: float = DIFFERENT) -> None:
    """Fly with the hover thrust measured before the take-over, if it differs from the model's by
    more than the share `least`."""
    model = flight.model
    shown = flight.hover.hover_thrust(model, flight.time_s)
    if shown is None or abs(shown / model.hover_thrust - 1.0) <= least:
        return
    flight.model = model.model_copy(update={"hover_thrust": shown})
    flight.observer.set_vehicle(flight.model)
    if flight.identification:
        flight.identification.on_shown({"hover_thrust": shown})
    outbox.announce(
        flight,
        f"hover thrust {shown:.3f} instead of {model.hover_thrust:.3f}, measured before the "
        "take-over",
    )
