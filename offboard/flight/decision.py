"""The decision of one tick: predict the state, call the control law, and send its command.

After the setpoint was sent, log the decision and identify the vehicle. Failures of the law are
counted and never raised, because the vehicle is in the air.
"""

from __future__ import annotations

import math
from dataclasses import astuple
from operator import sub

from offboard.control.bandwidth import tilting_bandwidth
from offboard.control.base import Adaptive, Situation, decision_of
from offboard.documents.errors import located
from offboard.flight import failsafe, outbox
from offboard.flight.outbox import Refused
from offboard.flight.phases import Phase
from offboard.flight.record import (
    CERTIFIED,
    DECISION_FAILED,
    RECORD_ID,
    RECORD_NAME,
    Decided,
    Refusal,
    TickRecord,
    identified_record,
)
from offboard.flight.state import FlightState
from offboard.identification.learner import Learner, VehicleUpdate
from offboard.mavlink.outgoing import ReferenceRecord, SolverRecord
from offboard.model.command import Command

DECISION_MISSED = "decision missed: "
NOTICEABLE_RADPS = 0.5  # a smaller change of the bandwidth is not announced
# why a decision was missed: in a word -> in a clause
_BY = {
    "controller": "the controller failed",
    "link": "telemetry was too old for a setpoint",
    "computer": "this computer was too busy",
}
# cause of a refusal that is not the fault of a law that decided within a period
_NOT_OF_THE_LAW: dict[int, str] = {Refusal.STALE: "link", Refusal.LATE: "computer"}


def begin(flight: FlightState) -> None:
    """Give the controller the vehicle model, with the uncertainty that it has before it is
    identified. Call this before the first decision."""
    if flight.identification and isinstance(flight.controller, Adaptive):
        flight.controller.set_vehicle(flight.model, flight.identification.uncertainty)
        flight.told_radps = 2 * (flight.controller.configured_radps,)


def decide(flight: FlightState) -> bool:
    """Decide, and queue the setpoint.

    Returns False, and increases `missed_decisions`, if the decision failed or was refused; then
    nothing is sent. Two cases return False and do not increase it: telemetry that was too old
    before the decision began, for which the failsafe has a row, and an observer that has no
    position or no attitude yet, because a service may be engaged again right after a flight.
    """
    if not flight.observer.ready:
        return False
    was_old = failsafe.telemetry_old(flight)
    try:
        decided = _call_law(flight)
        _send(flight, decided)
    except Exception as error:  # any error: the vehicle is in the air
        _miss(flight, located(error), "controller", DECISION_FAILED)
        return False
    flight.decided = decided
    if was_old and decided.refused == Refusal.STALE:
        return False
    if decided.failure:
        in_time = decided.solve_time_s <= flight.period_s
        late = _NOT_OF_THE_LAW.get(decided.refused, "controller")
        _miss(flight, decided.failure, late if in_time else "controller")
        return False
    flight.predictions.append(decided.state)
    return True


def finish(flight: FlightState, sent_s: float) -> None:
    """Log the decision and identify the vehicle. The setpoint was sent at host time `sent_s`."""
    decided, flight.decided = flight.decided, None
    if decided is None:
        return
    try:
        _record(flight, decided, sent_s - flight.telemetry_arrived_s)
    except Exception as error:  # the certificate comes from the law and may be unusable
        _miss(flight, located(error), "controller", DECISION_FAILED)
        return
    if not decided.refused:
        flight.missed_decisions = 0
        if flight.identification:
            _identify(flight, flight.identification)


def _miss(flight: FlightState, failure: str, cause: str, begins: str = DECISION_MISSED) -> None:
    flight.missed_decisions += 1
    flight.failure, flight.failure_cause = f"{_BY[cause]}: {failure}", cause
    outbox.warn(flight, f"{begins}{failure}")


def _send(flight: FlightState, decided: Decided) -> None:
    """Send the command if `outbox.admit` allows it. Its age and lateness are measured now, in host
    time."""
    command, host_s, late_s = decided.decision.command, flight.host_s, 0.0
    if flight.deadline_s is not None:
        host_s = flight.stopwatch()
        late_s = host_s - flight.telemetry_arrived_s - flight.period_s
    decided.age_s = flight.telemetry_age_s(host_s)
    if flight.identification and flight.phase is Phase.EXCITE and isinstance(command, Command):
        command = flight.identification.excited(command, flight.time_s, flight.position_error_m)
    body_z_down = float(decided.state.thrust_direction_ned[2])
    try:
        decided.sent = outbox.send_setpoint(
            flight, flight.time_s, command, body_z_down, age_s=decided.age_s, late_s=late_s
        )
    except Refused as refused:
        decided.refused, decided.failure = refused.why, str(refused)


def _identify(flight: FlightState, identification: Learner) -> None:
    try:
        hover_thrust = flight.observer.hover_thrust_estimate
        update = identification.learn(flight.time_s, hover_thrust)
        if update is not None:
            _set_vehicle(flight, update)
    except Exception as error:  # the flight continues with the present vehicle model
        identification.give_up()
        outbox.warn(flight, f"identification stopped: {located(error)}")


def _call_law(flight: FlightState) -> Decided:
    plan = flight.plan
    assert plan.reference is not None
    time_s = flight.delays_begin_s(flight.time_s)
    state = flight.observer.predict(time_s)
    began_s, deadline_s = flight.stopwatch(), flight.deadline_s or math.inf

    def remaining_s() -> float:
        return deadline_s - (flight.stopwatch() - began_s)

    situation = Situation(
        time_s,
        state,
        plan.reference,
        previous=flight.command,
        remaining_s=remaining_s if flight.deadline_s is not None else None,
        origin_ned_m=plan.origin_ned_m,
        track_time_s=plan.track_time_s(time_s),
    )
    decision = decision_of(flight.controller, situation)
    return Decided(flight.phase, state, decision, flight.stopwatch() - began_s)


def _set_vehicle(flight: FlightState, update: VehicleUpdate) -> None:
    assert isinstance(flight.controller, Adaptive)
    flight.controller.set_vehicle(update.vehicle, update.uncertainty)
    if update.vehicle != flight.model:
        flight.observer.set_vehicle(update.vehicle)
        flight.model = update.vehicle
    if update.record:
        outbox.send(flight, identified_record(flight.time_s, update.record))
    for sentence in _with_bandwidth(flight, update, flight.controller):
        outbox.announce(flight, sentence)


def _with_bandwidth(
    flight: FlightState, update: VehicleUpdate, controller: Adaptive
) -> tuple[str, ...]:
    """Return the sentences for the user, with the bandwidth in use if it has changed noticeably."""
    used, configured_radps = controller.bandwidth, controller.configured_radps
    changed_radps = max(map(abs, map(sub, used, flight.told_radps)))
    as_configured = set(used) == {configured_radps}
    if not changed_radps or (changed_radps < NOTICEABLE_RADPS and not as_configured):
        return update.sentences
    flight.told_radps = used
    text = f"bandwidth limited to {used} (configured {configured_radps:.1f})"
    if as_configured:
        text = f"bandwidth {used} as configured"
    causes = [update.cause] if update.cause else []
    tilting_radps, slow = tilting_bandwidth(update.vehicle)
    if used.lateral_radps == tilting_radps and not as_configured:
        causes.insert(0, slow)
    if causes:
        return (*update.sentences, f"{text}: {'; '.join(causes)}")
    return ("; ".join((*update.sentences, text)),)


def _record(flight: FlightState, decided: Decided, answer_s: float) -> None:
    sample = flight.plan.sample(flight.time_s)
    assert sample is not None
    time_s, tick = flight.time_s, tick_record(flight, decided, answer_s)
    reference = ReferenceRecord(time_s, sample.setpoint())
    outbox.send(flight, reference, SolverRecord(time_s, tick, RECORD_ID, RECORD_NAME))


def tick_record(flight: FlightState, decided: Decided, answer_s: float) -> TickRecord:
    """Return the record of a tick, with the certificate only if the setpoint was sent unchanged."""
    sent, state = decided.sent, decided.state
    # with a position setpoint, the autopilot chooses thrust and direction
    attitude = sent if isinstance(sent, Command) else None
    certified = sent == decided.decision.command
    figures = astuple(decided.decision.certificate) if certified else (math.nan,) * CERTIFIED
    *certificate, seed_cost = map(float, figures)
    values = (
        float(decided.phase.code),
        attitude.thrust_mps2 if attitude else math.nan,
        *(attitude.thrust_direction_ned if attitude else (math.nan, math.nan, math.nan)),
        sent.heading_rad if sent else math.nan,
        *certificate,
        decided.solve_time_s,
        answer_s,
        float(flight.busyness.newly_skipped),
        *state.position_ned_m.tolist(),
        *state.velocity_ned_mps.tolist(),
        *state.disturbance_ned_mps2.tolist(),
        flight.observer.hover_thrust_estimate,
        flight.track_time_s,
        seed_cost,
        decided.age_s,
        float(decided.refused),
        float(flight.ignored),
        flight.busyness.paused_s,
    )
    return TickRecord(*values)
