"""Decision of one tick: predict the state, call the control law, and send its command by the gate.

Once the setpoint has left, log the decision and identify the vehicle. Failures of the law are
counted, never raised: the vehicle is in the air.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from offboard.control.base import Adopting, Controller, Decision, Situation
from offboard.documents.errors import located
from offboard.estimation.observer import Observer
from offboard.flight.gate import Refusal, Refused
from offboard.flight.online_identification import Adoption, OnlineIdentification
from offboard.flight.outbox import Outbox
from offboard.flight.phases import PHASE_CODES, Phase
from offboard.flight.record import (
    IDENTIFIED_ID,
    IDENTIFIED_NAME,
    RECORD_ID,
    RECORD_NAME,
    TickRecord,
    reference_record,
)
from offboard.flight.state import FlightState
from offboard.mavlink.outgoing import SolverRecord
from offboard.model.command import Command, PositionCommand
from offboard.model.predicted_state import PredictedState

NOTICEABLE_RADPS = 0.5  # a smaller change of the bandwidth is not announced
_FAILED, _TOO_OLD = "the controller failed", "telemetry was too old for a setpoint"


@dataclass(frozen=True, slots=True)
class Tick:
    """One control tick."""

    time_s: float  # vehicle time
    phase: Phase
    in_phase_s: float
    arrived_s: float  # host time of the arrival of the telemetry that caused the tick
    missed: int = 0  # ticks skipped since the previous one
    strangers: int = 0  # datagrams of other senders since the previous one
    pause_s: float = 0.0  # of this process, since the previous one


@dataclass(frozen=True, slots=True)
class Decided:
    """A decision, the predicted state it was made for, and what became of it."""

    state: PredictedState
    decision: Decision
    solve_time_s: float
    sent: Command | PositionCommand | None = None
    age_s: float = 0.0  # of its telemetry, at the gate
    refused: Refusal | None = None
    failure: str = ""  # why it was refused


class Decider:
    """Calls `controller`. `stopwatch` reads host time. `deadline_s` is None where the vehicle waits
    for each decision, so that nothing can be late or old."""

    def __init__(
        self,
        *,
        state: FlightState,
        controller: Controller,
        observer: Observer,
        identification: OnlineIdentification | None,
        outbox: Outbox,
        period_s: float,
        deadline_s: float | None,
        stopwatch: Callable[[], float],
    ) -> None:
        self._state = state
        self._controller = controller
        self._observer = observer
        self._identification = identification
        self._outbox = outbox
        self._period_s = period_s
        self._deadline_s = deadline_s
        self._stopwatch = stopwatch
        self._unfinished: tuple[Tick, Decided] | None = None
        self._announced_radps = math.nan  # bandwidth in use, as the user knows it

    def begin(self) -> None:
        """Before the first decision: the vehicle is not identified yet."""
        if self._identification and isinstance(self._controller, Adopting):
            self._controller.adopt(self._state.model, self._identification.uncertainty)
            self._announced_radps = self._controller.configured_radps

    def decide(self, tick: Tick) -> bool:
        """Decide, and queue the setpoint.

        Returns False, and increases `missed`, if the decision failed or the gate refused it; then
        nothing is sent. Telemetry that was too old before the decision began does not count: the
        failsafe has a row for it.
        """
        was_old = self._state.telemetry_is_old
        try:
            decided = self._send(tick, self._decided(tick))
        except Exception as error:  # any error: the vehicle is in the air
            self._miss(located(error), _FAILED)
            return False
        self._unfinished = tick, decided
        if was_old and decided.refused is Refusal.STALE:
            return False
        if decided.failure:
            in_time = decided.solve_time_s <= self._period_s
            aged = decided.refused is Refusal.STALE and in_time
            self._miss(decided.failure, _TOO_OLD if aged else _FAILED)
            return False
        self._state.predictions.append(decided.state)
        return True

    def finish(self, sent_s: float) -> None:
        """After the setpoint was sent, at host time `sent_s`: log the decision and identify."""
        if self._unfinished is None:
            return
        (tick, decided), self._unfinished = self._unfinished, None
        try:
            self._record(tick, decided, sent_s - tick.arrived_s)
        except Exception as error:  # the certificate is the law's
            self._miss(located(error), _FAILED)
            return
        if decided.refused is None:
            self._state.missed = 0
            if self._identification:
                self._identify(tick, self._identification)

    def _miss(self, failure: str, by: str) -> None:
        self._state.missed += 1
        self._state.failure = f"{by}: {failure}"
        self._outbox.warn(f"decision missed: {failure}")

    def _send(self, tick: Tick, decided: Decided) -> Decided:
        """Send the command, if the gate admits it."""
        age_s, late_s = self._age_and_lateness(tick)
        try:
            sent = self._sent(tick, decided, age_s, late_s)
        except Refused as refused:
            return replace(decided, age_s=age_s, refused=refused.why, failure=str(refused))
        return replace(decided, age_s=age_s, sent=sent)

    def _sent(
        self, tick: Tick, decided: Decided, age_s: float, late_s: float
    ) -> Command | PositionCommand:
        command, outbox = decided.decision.command, self._outbox
        if not isinstance(command, Command):
            return outbox.send_position(tick.time_s, command, age_s=age_s, late_s=late_s)
        excited = self._excited(command, tick)
        body_z_down = float(decided.state.thrust_direction_ned[2])
        return outbox.send_command(tick.time_s, excited, body_z_down, age_s=age_s, late_s=late_s)

    def _age_and_lateness(self, tick: Tick) -> tuple[float, float]:
        """Age of the telemetry, and time since the end of the tick; both now, in host time."""
        if self._deadline_s is None:
            return 0.0, 0.0
        host_s = self._stopwatch()
        return self._state.telemetry_age_s(host_s), host_s - tick.arrived_s - self._period_s

    def _identify(self, tick: Tick, identification: OnlineIdentification) -> None:
        try:
            adoption = identification.learn(
                tick.phase, tick.time_s, self._observer.hover_thrust_estimate
            )
            if adoption is not None:
                self._adopt(tick.time_s, adoption)
        except Exception as error:  # the flight continues with the present vehicle model
            identification.give_up()
            self._outbox.warn(f"identification stopped: {located(error)}")

    def _decided(self, tick: Tick) -> Decided:
        plan = self._state.plan
        assert plan.reference is not None
        sent_s = self._state.sent_s(tick.time_s)
        state = self._observer.predict(sent_s)
        began_s = self._stopwatch()
        situation = Situation(
            sent_s,
            state,
            plan.reference,
            previous=self._outbox.command,
            remaining_s=self._remaining(began_s),
            origin_ned_m=plan.origin_ned_m,
            track_time_s=plan.track_time_s(sent_s),
        )
        decision = self._controller.decide(situation)
        return Decided(state, decision, self._stopwatch() - began_s)

    def _remaining(self, began_s: float) -> Callable[[], float] | None:
        deadline_s = self._deadline_s
        if deadline_s is None:
            return None
        return lambda: deadline_s - (self._stopwatch() - began_s)

    def _excited(self, command: Command, tick: Tick) -> Command:
        if self._identification is None or tick.phase is not Phase.EXCITE:
            return command
        return self._identification.excited(command, tick.time_s, self._state.position_error_m)

    def _adopt(self, time_s: float, adoption: Adoption) -> None:
        assert isinstance(self._controller, Adopting)
        self._controller.adopt(adoption.vehicle, adoption.uncertainty)
        if adoption.vehicle != self._state.model:
            self._observer.adopt(adoption.vehicle)
            self._state.model = adoption.vehicle
        if adoption.record:
            record = SolverRecord(time_s, adoption.record, IDENTIFIED_ID, IDENTIFIED_NAME)
            self._outbox.send(record)
        for sentence in self._with_bandwidth(adoption, self._controller):
            self._outbox.announce(sentence)

    def _with_bandwidth(self, adoption: Adoption, controller: Adopting) -> tuple[str, ...]:
        """The sentences for the user, and the bandwidth in use if it has changed noticeably."""
        used_radps, configured_radps = controller.bandwidth_radps, controller.configured_radps
        changed_radps = abs(used_radps - self._announced_radps)
        as_configured = used_radps == configured_radps
        if not changed_radps or (changed_radps < NOTICEABLE_RADPS and not as_configured):
            return adoption.sentences
        self._announced_radps = used_radps
        text = f"bandwidth limited to {used_radps:.1f} rad/s (configured {configured_radps:.1f})"
        if as_configured:
            text = f"bandwidth {used_radps:.1f} rad/s as configured"
        if adoption.cause:
            return (*adoption.sentences, f"{text}: {adoption.cause}")
        return ("; ".join((*adoption.sentences, text)),)

    def _record(self, tick: Tick, decided: Decided, answer_s: float) -> None:
        sample = self._state.plan.sample(tick.time_s)
        assert sample is not None
        self._outbox.send(reference_record(tick.time_s, sample))
        record = TickRecord.of(
            phase=PHASE_CODES[tick.phase],
            decision=decided.decision,
            sent=decided.sent,
            state=decided.state,
            solve_time_s=decided.solve_time_s,
            answer_s=answer_s,
            missed_ticks=tick.missed,
            hover_thrust=self._observer.hover_thrust_estimate,
            track_time_s=self._state.plan.track_time_s(tick.time_s),
            age_s=decided.age_s,
            refused=decided.refused or 0,
            strangers=tick.strangers,
            pause_s=tick.pause_s,
        )
        self._outbox.send(SolverRecord(tick.time_s, record.data(), RECORD_ID, RECORD_NAME))
