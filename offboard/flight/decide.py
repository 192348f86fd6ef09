"""Decision of one tick: predict the state, call the control law, check, limit and send its command.

Then log the decision and identify the vehicle. Failures of the law are counted, never raised: the
vehicle is in the air.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from offboard.control.base import Adopting, Controller, Decision, DecisionError, Situation
from offboard.estimation.observer import Observer
from offboard.flight.assessment import Assessment
from offboard.flight.flight_plan import FlightPlan
from offboard.flight.gate import clamp, usable
from offboard.flight.online_identification import RECORD_ID as IDENTIFIED_ID
from offboard.flight.online_identification import RECORD_NAME as IDENTIFIED_NAME
from offboard.flight.online_identification import Adoption, OnlineIdentification
from offboard.flight.outbox import Outbox
from offboard.flight.phases import PHASE_CODES, Phase
from offboard.flight.record import RECORD_ID, RECORD_NAME, TickRecord, reference_record
from offboard.mavlink.outgoing import SolverRecord
from offboard.model.command import Command, PositionCommand
from offboard.model.predicted_state import PredictedState


@dataclass(frozen=True, slots=True)
class Tick:
    """One control tick."""

    time_s: float  # vehicle time
    phase: Phase
    in_phase_s: float
    arrived_s: float  # stopwatch, on arrival of the telemetry that caused the tick
    missed: int = 0  # ticks skipped since the previous one


@dataclass(frozen=True, slots=True)
class Decided:
    """A decision and the predicted state it was made for; `command` is checked and limited."""

    state: PredictedState
    decision: Decision
    command: Command | PositionCommand
    solve_time_s: float


class Decider:
    """Calls `controller`. `stopwatch` reads seconds, for solve times only.

    `missed` counts failed decisions in a row, `failure` describes the newest.
    """

    def __init__(
        self,
        *,
        controller: Controller,
        observer: Observer,
        plan: FlightPlan,
        assessment: Assessment,
        identification: OnlineIdentification | None,
        outbox: Outbox,
        deadline_s: float | None,
        stopwatch: Callable[[], float],
    ) -> None:
        self._controller = controller
        self._observer = observer
        self._plan = plan
        self._assessment = assessment
        self._identification = identification
        self._outbox = outbox
        self._deadline_s = deadline_s
        self._stopwatch = stopwatch
        self.missed = 0
        self.failure = ""

    def begin(self) -> None:
        """Before the first decision: limit the bandwidth until the vehicle is identified."""
        if self._identification and isinstance(self._controller, Adopting):
            limit_radps = self._identification.cautious_bandwidth_radps
            self._controller.adopt(self._outbox.vehicle, limit_radps)

    def decide(self, tick: Tick) -> bool:
        """Decide, send the setpoint, log the decision, then identify.

        Returns False, and increases `missed`, if the decision failed; then nothing is sent.
        """
        try:
            decided = self._decided(tick)
        except Exception as error:  # any error: the vehicle is in the air
            self.missed += 1
            self.failure = f"{type(error).__name__}: {error}"
            self._outbox.warn(f"decision missed: {self.failure}")
            return False
        self.missed = 0
        if isinstance(decided.command, PositionCommand):
            self._outbox.send_position(tick.time_s, decided.command)
        else:
            body_z_down = float(decided.state.thrust_direction_ned[2])
            self._outbox.send_command(tick.time_s, decided.command, body_z_down)
        self._record(tick, decided)
        if self._identification:
            self._identify(tick, self._identification)
        return True

    def _identify(self, tick: Tick, identification: OnlineIdentification) -> None:
        try:
            adoption = identification.learn(tick.phase, tick.time_s)
            if adoption is not None:
                self._adopt(tick.time_s, adoption)
        except Exception as error:  # the flight continues with the present vehicle model
            identification.give_up()
            self._outbox.warn(f"identification stopped: {error}")

    def _decided(self, tick: Tick) -> Decided:
        reference = self._plan.reference
        assert reference is not None
        state = self._observer.predict(tick.time_s)
        began_s = self._stopwatch()
        situation = Situation(
            tick.time_s,
            state,
            reference,
            previous=self._outbox.command,
            remaining_s=self._remaining(began_s),
            origin_ned_m=self._plan.origin_ned_m,
            track_time_s=self._plan.track_time_s(tick.time_s),
        )
        decision = self._controller.decide(situation)
        solve_time_s = self._stopwatch() - began_s
        command = decision.command
        if isinstance(command, Command):
            command = clamp(self._excited(command, tick), self._outbox.vehicle)
        if not usable(command):
            raise DecisionError(f"unusable {command}")
        return Decided(state, decision, command, solve_time_s)

    def _remaining(self, began_s: float) -> Callable[[], float] | None:
        deadline_s = self._deadline_s
        if deadline_s is None:
            return None
        return lambda: deadline_s - (self._stopwatch() - began_s)

    def _excited(self, command: Command, tick: Tick) -> Command:
        if self._identification is None or tick.phase is not Phase.EXCITE:
            return command
        return self._identification.excited(
            command, tick.time_s, self._assessment.position_error_m()
        )

    def _adopt(self, time_s: float, adoption: Adoption) -> None:
        assert isinstance(self._controller, Adopting)
        limit = adoption.bandwidth_limit_radps
        self._controller.adopt(adoption.vehicle, limit, gains=adoption.gains)
        self._observer.adopt(adoption.vehicle)
        self._outbox.vehicle = adoption.vehicle
        if adoption.record:
            record = SolverRecord(time_s, adoption.record, IDENTIFIED_ID, IDENTIFIED_NAME)
            self._outbox.send(record)
        for sentence in adoption.sentences:
            self._outbox.announce(sentence)

    def _record(self, tick: Tick, decided: Decided) -> None:
        sample = self._plan.sample(tick.time_s)
        assert sample is not None
        self._outbox.send(reference_record(tick.time_s, sample))
        record = TickRecord.of(
            phase=PHASE_CODES[tick.phase],
            decision=decided.decision,
            sent=decided.command,
            state=decided.state,
            solve_time_s=decided.solve_time_s,
            lateness_s=self._stopwatch() - tick.arrived_s,
            missed_ticks=tick.missed,
            hover_thrust=self._observer.hover_thrust_estimate,
            track_time_s=self._plan.track_time_s(tick.time_s),
        )
        self._outbox.send(SolverRecord(tick.time_s, record.data(), RECORD_ID, RECORD_NAME))
