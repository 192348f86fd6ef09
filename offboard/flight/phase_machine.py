"""Phase machine: applies the failsafe and the phase table, and starts what begins with a phase."""

from __future__ import annotations

import numpy as np

from offboard.estimation.observer import Observer
from offboard.flight import failsafe
from offboard.flight.decide import Decider
from offboard.flight.flying import in_own_failsafe
from offboard.flight.hover_estimate import DIFFERENT, SETTLED, differs
from offboard.flight.online_identification import OnlineIdentification
from offboard.flight.outbox import Outbox
from offboard.flight.phases import BEFORE_FLIGHT, FLYING, WAITING, ExitCode, Phase
from offboard.flight.pilot_switch import PilotSwitch
from offboard.flight.requests import Request
from offboard.flight.rows import REBOOTED, Transition, why
from offboard.flight.state import FlightState, Outcome
from offboard.flight.touchdown import Touchdown
from offboard.flight.transitions import next_row
from offboard.mavlink.events import LocalPosition
from offboard.mavlink.session import Session

TAKEN = "a failsafe of the vehicle has it, as its HEARTBEAT shows"


class PhaseMachine:
    """Changes `phase`, `began_s` and `outcome` of the state."""

    def __init__(
        self,
        *,
        state: FlightState,
        session: Session,
        observer: Observer,
        decider: Decider,
        identification: OnlineIdentification | None,
        outbox: Outbox,
    ) -> None:
        self._state = state
        self._session = session
        self._observer = observer
        self._decider = decider
        self._identification = identification
        self._outbox = outbox

    def advance(self) -> None:
        """Make every transition whose guard holds."""
        flight = self._state
        while not flight.has_ended:
            if flight.phase in FLYING:
                failsafe.judge(flight)
            self._note_failsafe()
            row = next_row(flight)
            if row is None:
                break
            self._enter(row, why(row.reason, flight))
        flight.request = Request.NONE

    def _note_failsafe(self) -> None:
        """A landing by the vehicle's own failsafe is awaited, but it is not ours."""
        state = self._state
        fallen = state.phase is Phase.LAND and in_own_failsafe(state)
        if fallen and state.outcome is None:
            sentence = f"the vehicle's own failsafe flew it, in {state.vehicle.mode}"
            state.outcome = Outcome(ExitCode.ABORTED, sentence + self._explanation())

    def name_failsafe(self) -> None:
        """Say that a failsafe, and no pilot, has taken the vehicle: its newest HEARTBEAT shows
        one."""
        state = self._state
        if state.taken and state.vehicle.in_failsafe and state.outcome is not None:
            sentence = TAKEN + self._explanation()
            self._outbox.announce_once(sentence)
            before = state.outcome
            state.outcome = Outcome(before.exit_code, f"{before.sentence}; {sentence}")

    def on_reboot(self) -> None:
        """The vehicle was rebooted: this ends the flight, except while telemetry is awaited. A
        landing goes on, but the flight is none that was flown to its end."""
        state = self._state
        state.rebooted = state.phase not in (Phase.CONNECT, Phase.HEALTH)
        state.pilot = PilotSwitch(unclaimed=state.service is not None)
        if state.phase is Phase.LAND:
            state.touchdown = Touchdown(None)
            if state.outcome is None:
                state.outcome = Outcome(ExitCode.ABORTED, f"{REBOOTED} while landing")
        self.advance()

    def _enter(self, row: Transition, reason: str) -> None:
        state = self._state
        source = state.phase
        self._conclude(row, reason)
        state.vehicle.clear_messages()
        state.request = Request.NONE
        state.phase = row.target
        state.began_s = state.now_s
        self._outbox.announce(f"{row.target.value}: {reason}", title="offboard: ")
        if source in BEFORE_FLIGHT and row.target in FLYING:
            state.clock.settle()
            dialect = self._session.dialect
            assert dialect is not None
            state.positioning.begin(state.vehicle, self._session.rates_hz, dialect.estimator_name)
            if self._identification:
                self._identification.on_link_delay(state.clock.delay)
            if source is Phase.ARM:  # on the ground the time that it takes does no harm
                self._decider.begin()
        if self._identification:
            self._identification.on_phase(row.target, state.time_s)
        if source in WAITING and row.target in FLYING and state.authority:
            state.authority.ask()  # it shows the mode already
        if row.target is Phase.ENGAGE:
            self._begin_engaging()
        elif row.target is Phase.STANDBY:
            state.pilot.engaged = False  # the pilot switched to one that was not ready
        elif row.target is Phase.TAKEOFF:
            self._begin_takeoff()
        elif row.target is Phase.CLIMB:
            self._begin_climb(source)
        elif row.target is Phase.JOIN:
            state.plan.start_track(state.time_s)
        elif row.target is Phase.PAUSE:
            state.plan.pause(state.time_s)
        elif source is Phase.PAUSE and row.target is Phase.TRACK:
            state.plan.resume(state.time_s)
        elif row.target is Phase.LAND:
            state.touchdown = Touchdown(state.takeoff_ned_m)

    def _conclude(self, row: Transition, reason: str) -> None:
        """The most severe exit code counts; later reasons are added to the first sentence."""
        state = self._state
        if row.exit_code is not None:
            if state.outcome is None:
                state.outcome = Outcome(row.exit_code, reason + self._explanation())
            else:
                sentence = f"{state.outcome.sentence}; {reason}"
                state.outcome = Outcome(max(state.outcome.exit_code, row.exit_code), sentence)
        elif row.target is Phase.DISARMED and state.outcome is None:
            state.outcome = Outcome(ExitCode.FLOWN, "flown and landed")

    def _explanation(self) -> str:
        dialect = self._state.dialect
        return self._state.vehicle.explanation(dialect.unsaid if dialect else "")

    def _begin_engaging(self) -> None:
        """Here, not with the request: a vehicle that shows the mode already passes without one."""
        assert self._state.authority is not None
        self._state.authority.ask()
        self._adopt_hover_thrust()

    def _begin_takeoff(self) -> None:
        position = self._state.vehicle.position
        assert position is not None
        state = self._state
        state.takeoff_ned_m = state.plan.origin_ned_m = position.position_ned_m
        state.home_ned_m = state.takeoff_ned_m

    def _begin_climb(self, source: Phase) -> None:
        """To the start of the reference, after the take-off, in the air, or once more."""
        state = self._state
        position = state.vehicle.position
        assert position is not None
        flown = state.plan.sample(state.time_s)
        if flown is not None:  # from where the reference is: the vehicle follows it
            course_rad = float(flown.course_rad)
            state.plan.start_climb(
                state.time_s, flown.position_ned_m, flown.velocity_ned_mps, course_rad
            )
            return
        in_the_air = source is not Phase.TAKEOFF
        if in_the_air:
            self._place_reference(position)
        if in_the_air or state.takes_off_by_command:
            self._adopt_hover_thrust(SETTLED if source is Phase.STANDBY else DIFFERENT)
        self._observer.freeze(False)
        self._decider.begin()
        state.plan.start_climb(
            state.time_s,
            np.array(position.position_ned_m),
            np.array(position.velocity_ned_mps),
            state.vehicle.course_rad,
        )

    def _place_reference(self, position: LocalPosition) -> None:
        """Place the reference of a vehicle that was found in the air. A take-off point that was not
        seen is below it, at the height of its last rest."""
        state, contact = self._state, self._state.contact
        state.home_ned_m = (*position.position_ned_m[:2], contact.rest_down_m)
        if state.service and state.service.anchor == "here":
            rest = contact.rest_ned_m
            above_m = state.plan.place_start(
                position.position_ned_m, position.velocity_ned_mps, rest[2] if rest else None
            )
            if above_m:
                self._outbox.announce(
                    f"the reference starts {above_m:.1f} m higher: from here it would "
                    + ("touch the ground" if rest else "go lower, and the ground is not known")
                )
        elif contact.rest_ned_m is not None and state.service:
            state.plan.origin_ned_m = contact.rest_ned_m
        else:
            state.plan.origin_ned_m = state.home_ned_m

    def _adopt_hover_thrust(self, least: float = DIFFERENT) -> None:
        """Fly with the hover thrust that the autopilot's own flight shows, if it is another."""
        state, model = self._state, self._state.model
        shown = state.hover.hover_thrust(model, state.time_s)
        if shown is None or not differs(shown, model, least):
            return
        state.model = model.model_copy(update={"hover_thrust": shown})
        self._observer.adopt(state.model)
        if self._identification:
            self._identification.on_hover_thrust(shown)
        self._outbox.announce(
            f"hover thrust {shown:.3f} by thrust and acceleration before the take-over, "
            f"not {model.hover_thrust:.3f}"
        )
