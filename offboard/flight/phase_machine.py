"""Phase machine: applies the phase table, and starts what begins with a phase.

`Assessment` gives the facts, `transitions` the row. Holds the phase, its start, and the outcome.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from offboard.estimation.observer import Observer
from offboard.flight.assessment import Assessment, Progress
from offboard.flight.decide import Decider
from offboard.flight.flight_plan import FlightPlan
from offboard.flight.link_delay import LinkDelay
from offboard.flight.online_identification import OnlineIdentification
from offboard.flight.outbox import Outbox
from offboard.flight.phases import ENDS, ExitCode, Phase
from offboard.flight.state import VehicleState
from offboard.flight.transitions import Row, next_row
from offboard.mavlink.session import Session


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a flight ended: an exit code of `phases.ExitCode`, and one sentence."""

    exit_code: int
    sentence: str


class PhaseMachine:
    """The phase of one flight. `stop_reason`: why the flight shall end, or empty; `silence_s`:
    wall time since the last telemetry."""

    def __init__(
        self,
        *,
        state: VehicleState,
        session: Session,
        plan: FlightPlan,
        observer: Observer,
        assessment: Assessment,
        decider: Decider,
        identification: OnlineIdentification | None,
        outbox: Outbox,
        link_delay: LinkDelay,
    ) -> None:
        self._state = state
        self._session = session
        self._plan = plan
        self._observer = observer
        self._assessment = assessment
        self._decider = decider
        self._identification = identification
        self._outbox = outbox
        self._link_delay = link_delay
        self.phase = Phase.CONNECT
        self.outcome: Outcome | None = None
        self.stop_reason = ""
        self.silence_s = 0.0
        self._rebooted = False
        self._began_s = 0.0  # on the session's link time

    def has_ended(self) -> bool:
        return self.phase in ENDS

    @property
    def in_phase_s(self) -> float:
        """Seconds since the phase began, on `Session.link_time_s`."""
        return self._session.link_time_s - self._began_s

    def advance(self) -> None:
        """Make every transition whose guard holds."""
        while not self.has_ended():
            progress = self._progress()
            facts = self._assessment.facts(progress)
            row = next_row(self.phase, facts)
            if row is None:
                return
            self._enter(row, row.reason.format(**self._assessment.figures(facts, progress)))

    def on_reboot(self) -> None:
        """The vehicle was rebooted: this ends the flight, except while telemetry is awaited."""
        self._rebooted = self.phase not in (Phase.CONNECT, Phase.HEALTH)
        self.advance()

    def _progress(self) -> Progress:
        identification = self._identification
        return Progress(
            phase=self.phase,
            in_phase_s=self.in_phase_s,
            silence_s=self.silence_s,
            rebooted=self._rebooted,
            stop_reason=self.stop_reason,
            missed_decisions=self._decider.missed,
            failure=self._decider.failure,
            contradiction=identification.contradiction if identification else "",
            excites=identification is not None and identification.wants_excitation,
            identified=identification is not None and identification.finished(self._state.time_s),
        )

    def _enter(self, row: Row, reason: str) -> None:
        self._conclude(row, reason)
        self._state.clear_messages()
        self.phase = row.target
        self._began_s = self._session.link_time_s
        self._outbox.restart_requests()
        self._outbox.announce(f"{row.target.value}: {reason}", title="offboard: ")
        if self._identification:
            if row.target is Phase.CLIMB:
                self._identification.on_link_delay(self._link_delay.estimate)
            self._identification.on_phase(row.target, self._state.time_s)
        if row.target is Phase.TAKEOFF:
            self._begin_takeoff()
        elif row.target is Phase.CLIMB:
            self._begin_climb(in_the_air=row.source is Phase.ENGAGE)
        elif row.target is Phase.JOIN:
            self._plan.start_track(self._state.time_s)

    def _conclude(self, row: Row, reason: str) -> None:
        """The most severe exit code counts; later reasons are added to the first sentence."""
        if row.exit_code is not None:
            if self.outcome is None:
                self.outcome = Outcome(row.exit_code, reason + self._state.explanation())
            else:
                sentence = f"{self.outcome.sentence}; {reason}"
                self.outcome = Outcome(max(self.outcome.exit_code, row.exit_code), sentence)
        elif row.target is Phase.DISARMED and self.outcome is None:
            self.outcome = Outcome(ExitCode.FLOWN, "flown and landed")

    def _begin_takeoff(self) -> None:
        assert self._state.position is not None
        self._plan.origin_ned_m = self._state.position.position_ned_m

    def _begin_climb(self, *, in_the_air: bool) -> None:
        assert self._state.position is not None
        position_ned_m = self._state.position.position_ned_m
        velocity = np.array(self._state.position.velocity_ned_mps)
        if in_the_air:  # take-off point unknown: below the vehicle, at the local origin's height
            self._plan.origin_ned_m = (*position_ned_m[:2], 0.0)
        self._observer.freeze(False)
        self._decider.begin()
        self._plan.start_climb(
            self._state.time_s, np.array(position_ned_m), velocity, self._state.course_rad
        )
