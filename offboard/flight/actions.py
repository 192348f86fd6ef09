"""What each phase does at a tick: prepare, lift off, track, hold, land. The phase is given.

Requests and setpoints leave through `Outbox`; which phase follows is none of its business.
"""

from __future__ import annotations

from offboard.estimation.observer import Observer
from offboard.flight.assessment import Assessment
from offboard.flight.decide import Decider, Tick
from offboard.flight.flight_plan import FlightPlan
from offboard.flight.outbox import Outbox
from offboard.flight.phases import BEFORE_FLIGHT, TRACKING, Phase
from offboard.flight.readiness import Readiness
from offboard.flight.setpoint import LEVEL
from offboard.flight.view import VehicleView
from offboard.mavlink.dialects.base import TAKEOFF, Dialect
from offboard.mavlink.outgoing import CommandLong
from offboard.mavlink.session import Session
from offboard.model.command import Command, PositionCommand

SPOOL_UP_PER_S = 0.7  # thrust ramp before lift-off, in units of gravity
SPOOL_MAX = 2.0
TAKEOFF_HEIGHT_M = 3.0  # asked of an autopilot that takes off by itself; we take over on the way
LAND_STREAM_S = 3.0  # a refused landing ends in silence: the autopilot's own failsafe lands


class PhaseActions:
    """One flight's actions, phase by phase."""

    def __init__(
        self,
        *,
        view: VehicleView,
        session: Session,
        plan: FlightPlan,
        observer: Observer,
        readiness: Readiness,
        assessment: Assessment,
        decider: Decider,
        outbox: Outbox,
    ) -> None:
        self._view = view
        self._session = session
        self._plan = plan
        self._observer = observer
        self._readiness = readiness
        self._assessment = assessment
        self._decider = decider
        self._outbox = outbox

    def act(self, tick: Tick) -> None:
        """At most one setpoint, and the requests of the phase."""
        if tick.phase in BEFORE_FLIGHT:
            self._observer.freeze(True)
            self._prepare(tick)
        elif tick.phase is Phase.TAKEOFF:
            self._take_off(tick)
        elif tick.phase in TRACKING:
            self._track(tick)
        else:
            self.hold(tick)

    def hold(self, tick: Tick) -> None:
        """What a phase does that needs no state: level, and the request that ends the flight."""
        phase, time_s = tick.phase, tick.time_s
        # Before an autopilot's own takeoff is taken over it is not ours to fly
        ours = not self._assessment.lifted_by_command or self._plan.reference is not None
        if phase is Phase.TAKEOFF or phase in TRACKING:
            if ours:
                self._outbox.emit(time_s, self._level())
        elif phase is Phase.LAND:
            if not self._has_the_vehicle:
                return
            self._outbox.ask(self._dialect.land(), time_s)
            if ours and tick.in_phase_s < LAND_STREAM_S:
                self._outbox.emit(time_s, self._level())
        elif phase is Phase.STAND_DOWN:
            self._outbox.ask(CommandLong.disarm(), time_s)
            if ours:
                course_rad = self._outbox.command.course_rad
                self._outbox.emit(time_s, Command(0.0, LEVEL, course_rad))

    def _prepare(self, tick: Tick) -> None:
        if tick.phase is Phase.HEALTH:
            self._make_ready(tick.time_s)
            return
        if tick.phase is Phase.ENGAGE:
            self._outbox.ask(self._dialect.engage(), tick.time_s)
        elif tick.phase is Phase.ARM:
            self._outbox.ask(CommandLong.arm(), tick.time_s)
        # On the ground without thrust; in the air with what takes over from the autopilot
        flying = self._view.armed and self._view.in_the_air
        if self._assessment.lifted_by_command and not flying:
            return
        thrust_mps2 = self._outbox.hover_mps2() if flying else 0.0
        command = Command(thrust_mps2, LEVEL, self._view.course_rad)
        self._outbox.emit(tick.time_s, command)

    def _make_ready(self, time_s: float) -> None:
        known, now_s = self._view.parameters, self._session.link_time_s
        for request in self._readiness.due(self._dialect, known, now_s):
            self._outbox.send(request)
        stale = self._has_the_vehicle and not self._view.armed
        if stale and not self._view.prearm_ok:  # PX4 shows OFFBOARD again after a landing
            self._outbox.ask(self._dialect.hold(), time_s)

    def _take_off(self, tick: Tick) -> None:
        if self._assessment.lifted_by_command:
            self._watch_takeoff(tick.time_s)
            return
        spool = min(SPOOL_MAX, SPOOL_UP_PER_S * tick.in_phase_s)
        thrust_mps2 = spool * self._outbox.vehicle.gravity_mps2
        course_rad = self._outbox.command.course_rad
        self._outbox.emit(tick.time_s, Command(thrust_mps2, LEVEL, course_rad))

    def _watch_takeoff(self, time_s: float) -> None:
        """The autopilot lifts off; a setpoint without thrust would cancel that, so none is sent.

        Its thrust is about what hovers, which the observer must know to take over from it.
        """
        if TAKEOFF not in self._view.accepted:
            self._outbox.ask(self._dialect.take_off(TAKEOFF_HEIGHT_M), time_s)
        gravity_mps2 = self._outbox.vehicle.gravity_mps2
        self._outbox.assume(time_s, Command(gravity_mps2, LEVEL, self._view.course_rad))

    def _track(self, tick: Tick) -> None:
        decided = self._decider.decide(tick)
        if decided is None:
            self._outbox.emit(tick.time_s, self._level())
            return
        if isinstance(decided.command, PositionCommand):
            self._outbox.hand_over(tick.time_s, decided.command)
        else:
            body_z_down = float(decided.state.thrust_direction_ned[2])
            self._outbox.emit(tick.time_s, decided.command, body_z_down)
        self._decider.follow_up(tick, decided)

    def _level(self) -> Command:
        """Level, at the thrust that hovers; before lift-off at the thrust reached."""
        flying, command = self._plan.reference is not None, self._outbox.command
        thrust_mps2 = self._outbox.hover_mps2() if flying else command.thrust_mps2
        return Command(thrust_mps2, LEVEL, command.course_rad)

    @property
    def _has_the_vehicle(self) -> bool:
        """The vehicle obeys us: in any other mode it lands, or a failsafe or a pilot has it."""
        return self._view.mode == self._dialect.engage_mode

    @property
    def _dialect(self) -> Dialect:
        assert self._session.dialect is not None
        return self._session.dialect
