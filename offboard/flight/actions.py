"""Phase actions: what is sent at a tick in each phase. The phase is given, and not changed here."""

from __future__ import annotations

from offboard.estimation.observer import Observer
from offboard.flight.assessment import Assessment
from offboard.flight.decide import Decider, Tick
from offboard.flight.flight_plan import FlightPlan
from offboard.flight.gate import LEVEL
from offboard.flight.outbox import Outbox
from offboard.flight.phases import BEFORE_FLIGHT, TRACKING, Phase
from offboard.flight.readiness import Readiness
from offboard.flight.state import VehicleState
from offboard.mavlink.dialects.base import TAKEOFF, Dialect
from offboard.mavlink.outgoing import CommandLong
from offboard.mavlink.session import Session
from offboard.model.command import Command

SPOOL_UP_PER_S = 0.7  # thrust ramp before lift-off, in units of gravity
SPOOL_MAX = 2.0
TAKEOFF_HEIGHT_M = 3.0  # of an autopilot's own take-off, which setpoints replace on the way
LAND_STREAM_S = 3.0  # if the landing is refused, setpoints stop and the autopilot's failsafe lands


class PhaseActions:
    """The actions of one flight; they send through `outbox`."""

    def __init__(
        self,
        *,
        state: VehicleState,
        session: Session,
        plan: FlightPlan,
        observer: Observer,
        readiness: Readiness,
        assessment: Assessment,
        decider: Decider,
        outbox: Outbox,
    ) -> None:
        self._state = state
        self._session = session
        self._plan = plan
        self._observer = observer
        self._readiness = readiness
        self._assessment = assessment
        self._decider = decider
        self._outbox = outbox

    def act(self, tick: Tick) -> None:
        """Send the requests of the phase, and at most one setpoint."""
        if tick.phase in BEFORE_FLIGHT:
            self._observer.freeze(True)
            self._prepare(tick)
        elif tick.phase is Phase.TAKEOFF:
            self._take_off(tick)
        elif tick.phase not in TRACKING:
            self.hold(tick)
        elif not self._decider.decide(tick):
            self._outbox.send_command(tick.time_s, self._level())

    def hold(self, tick: Tick) -> None:
        """Send what needs no telemetry: level setpoints, and the request that ends the flight."""
        phase, time_s = tick.phase, tick.time_s
        # Until setpoints have replaced an autopilot's own take-off, none must be sent
        steers = not self._assessment.lifted_by_command or self._plan.reference is not None
        if phase is Phase.TAKEOFF or phase in TRACKING:
            if steers:
                self._outbox.send_command(time_s, self._level())
        elif phase is Phase.LAND:
            if not self._engaged:
                return
            self._outbox.request(self._dialect.land(), time_s)
            if steers and tick.in_phase_s < LAND_STREAM_S:
                self._outbox.send_command(time_s, self._level())
        elif phase is Phase.STAND_DOWN:
            self._outbox.request(CommandLong.disarm(), time_s)
            if steers:
                course_rad = self._outbox.command.course_rad
                self._outbox.send_command(time_s, Command(0.0, LEVEL, course_rad))

    def _prepare(self, tick: Tick) -> None:
        if tick.phase is Phase.HEALTH:
            self._request_parameters(tick.time_s)
            return
        if tick.phase is Phase.ENGAGE:
            self._outbox.request(self._dialect.engage(), tick.time_s)
        elif tick.phase is Phase.ARM:
            self._outbox.request(CommandLong.arm(), tick.time_s)
        # On the ground without thrust; in the air with the thrust that hovers
        flying = self._state.armed and self._state.in_the_air
        if self._assessment.lifted_by_command and not flying:
            return
        thrust_mps2 = self._outbox.hover_mps2() if flying else 0.0
        command = Command(thrust_mps2, LEVEL, self._state.course_rad)
        self._outbox.send_command(tick.time_s, command)

    def _request_parameters(self, time_s: float) -> None:
        known, now_s = self._state.parameters, self._session.link_time_s
        self._outbox.send(*self._readiness.due(self._dialect, known, now_s))
        stale = self._engaged and not self._state.armed
        if stale and not self._state.prearm_ok:  # PX4 returns to OFFBOARD after a landing
            self._outbox.request(self._dialect.hold(), time_s)

    def _take_off(self, tick: Tick) -> None:
        if self._assessment.lifted_by_command:
            self._request_takeoff(tick.time_s)
            return
        spool = min(SPOOL_MAX, SPOOL_UP_PER_S * tick.in_phase_s)
        thrust_mps2 = spool * self._outbox.vehicle.gravity_mps2
        course_rad = self._outbox.command.course_rad
        self._outbox.send_command(tick.time_s, Command(thrust_mps2, LEVEL, course_rad))

    def _request_takeoff(self, time_s: float) -> None:
        """The autopilot takes off. No setpoint is sent: without thrust it would cancel that.

        The autopilot's thrust is close to hover thrust; the observer needs it for the take-over.
        """
        if TAKEOFF not in self._state.accepted:
            self._outbox.request(self._dialect.take_off(TAKEOFF_HEIGHT_M), time_s)
        gravity_mps2 = self._outbox.vehicle.gravity_mps2
        self._outbox.set_command(time_s, Command(gravity_mps2, LEVEL, self._state.course_rad))

    def _level(self) -> Command:
        """Level, with the thrust that hovers; before lift-off with the thrust reached."""
        flying, command = self._plan.reference is not None, self._outbox.command
        thrust_mps2 = self._outbox.hover_mps2() if flying else command.thrust_mps2
        return Command(thrust_mps2, LEVEL, command.course_rad)

    @property
    def _engaged(self) -> bool:
        """The vehicle follows our setpoints; in another mode a failsafe or a pilot has control."""
        return self._state.mode == self._dialect.engage_mode

    @property
    def _dialect(self) -> Dialect:
        assert self._session.dialect is not None
        return self._session.dialect
