"""Phase actions: what is sent at a tick in each phase. The phase is given, and not changed here."""

from __future__ import annotations

import numpy as np

from offboard.estimation.observer import Observer
from offboard.flight.authority import Standing
from offboard.flight.decide import Decider, Tick
from offboard.flight.gate import LEVEL
from offboard.flight.ground_contact import STANDING_S, STILL_ARMED
from offboard.flight.outbox import Outbox
from offboard.flight.phases import BEFORE_FLIGHT, TRACKING, Phase
from offboard.flight.rows import other_sender
from offboard.flight.state import FlightState
from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.outgoing import CommandLong
from offboard.mavlink.session import Session
from offboard.model.command import Command
from offboard.model.frames import thrust_direction_from_quaternion

AUTOPILOT_VERSION = 148  # message id
FIT_EVERY_S = 4.0  # between two reductions of the telemetry: a backlog must drain first
SPOOL_UP_PER_S = 0.7  # thrust ramp before lift-off, in units of gravity
SPOOL_MAX = 2.0
SPOOL_UNSEEN = 0.9  # without a new position nothing must lift off, or climb
SPOOL_KNOWN_S = 0.2  # age of a position that shows the height
TAKEOFF_HEIGHT_M = 3.0  # of an autopilot's own take-off, which setpoints replace on the way
LAND_STREAM_S = 3.0  # if the landing is refused, setpoints stop and the autopilot's failsafe lands


class PhaseActions:
    """The actions of one flight; they send through `outbox`."""

    def __init__(
        self,
        *,
        state: FlightState,
        session: Session,
        observer: Observer,
        decider: Decider,
        outbox: Outbox,
    ) -> None:
        self._state = state
        self._session = session
        self._fitted_s = 0.0  # in the phase HEALTH
        self._waits = False  # for a vehicle that is not heard
        self._observer = observer
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
        elif self._state.ours and not self._decider.decide(tick):
            self._outbox.send_level(tick.time_s, self._level())

    def hold(self, tick: Tick) -> None:
        """Send what needs no telemetry: level setpoints, and the request that ends the flight."""
        phase, time_s = tick.phase, tick.time_s
        # Until setpoints have replaced an autopilot's own take-off, none must be sent
        steers = not self._state.takes_off_by_command or self._state.plan.reference is not None
        if phase is Phase.TAKEOFF or phase in TRACKING:
            if steers:
                self._outbox.send_level(time_s, self._level())
        elif phase in (Phase.HOLD, Phase.LAND):
            self._end(tick, steers=steers)
        elif phase is Phase.HAND_BACK:
            self._end(tick, steers=bool(self._state.commands))
        elif phase is Phase.STAND_DOWN:
            self._outbox.request(CommandLong.disarm())
            if steers:
                course_rad = self._outbox.command.course_rad
                self._outbox.send_level(time_s, Command(0.0, LEVEL, course_rad))

    def _end(self, tick: Tick, *, steers: bool) -> None:
        """Ask the autopilot to hold or to land, with level setpoints until it does."""
        dialect, authority = self._dialect, self._state.authority
        assert authority is not None
        holds = tick.phase is not Phase.LAND
        if not holds:
            self._await_link()
        mode = dialect.hold_mode if holds else dialect.land_mode
        fails = authority.standing is Standing.FAILSAFE
        if fails and authority.mode == dialect.return_mode:
            return  # the owner's choice for missing setpoints: it lands where it took off
        if authority.mode != mode:
            if self._outbox.request(dialect.hold() if holds else dialect.land()):
                authority.request(mode)
        elif not holds:
            self._disarm_if_standing()
        streams = steers and not self._waits and tick.in_phase_s < LAND_STREAM_S
        if streams and authority.mode == authority.engage_mode:
            self._outbox.send_level(tick.time_s, self._level())

    def _await_link(self) -> None:
        """Say once what is waited for; when the vehicle is heard again, what was asked of it counts
        for nothing."""
        unreached_s, limits = self._state.unreached_s, self._state.limits
        waited, self._waits = self._waits, unreached_s > 2.0 * limits.silence_s
        if self._waits and not waited:
            silent = self._state.silence_s > limits.silence_s
            missing = "telemetry" if silent else "report of the mode"
            self._outbox.announce(
                f"no {missing} for {unreached_s:.1f} s: waiting for the link, "
                "then landing is asked again"
            )
        elif waited and not self._waits:
            self._outbox.renew()
            self._outbox.announce(f"heard again: the vehicle shows {self._state.vehicle.mode}")

    def _disarm_if_standing(self) -> None:
        """Ask a vehicle that stands, and does not disarm by itself, to disarm. It is never forced
        to: by its own land detector the autopilot refuses in the air. While that detector says so,
        only the user can disarm."""
        contact = self._state.contact
        if not contact.stands:
            return
        if contact.detects_flight:
            self._outbox.announce_once(STILL_ARMED)
        elif self._outbox.request(CommandLong.disarm()):
            self._outbox.announce_once(
                f"disarming: {STANDING_S:.0f} s without motion on the ground, and the vehicle "
                "does not disarm by itself"
            )

    def _prepare(self, tick: Tick) -> None:
        if tick.phase is Phase.HEALTH:
            self.request_parameters()
            self._fit_telemetry(tick.in_phase_s)
            return
        if tick.phase is Phase.STANDBY:
            self._stand_by(tick.time_s)
            return
        if tick.phase is Phase.ENGAGE:
            self._outbox.request(self._dialect.engage())
        elif tick.phase is Phase.ARM:
            self._outbox.request(CommandLong.arm())
        # On the ground without thrust; in the air with the thrust that hovers
        flying = self._state.contact.in_the_air
        if self._state.takes_off_by_command and not flying:
            return
        thrust_mps2 = self._outbox.hover_mps2() if flying else 0.0
        command = Command(thrust_mps2, LEVEL, self._state.vehicle.course_rad)
        self._outbox.send_level(tick.time_s, command)

    def _stand_by(self, time_s: float) -> None:
        """PX4 accepts OFFBOARD only while setpoints arrive: stream what changes nothing. On the
        ground no thrust; in the air what the vehicle flies, unless a failsafe flies it, after which
        PX4 would return to OFFBOARD, or it flies setpoints of others."""
        state = self._state
        on_ground, vehicle = state.contact.certain, state.vehicle
        command = Command(0.0, LEVEL, vehicle.course_rad) if on_ground else self._flown()
        quiet = state.takes_off_by_command or state.telemetry_is_old or other_sender(state)
        if on_ground:
            quiet |= vehicle.armed and vehicle.in_failsafe
        else:
            quiet |= vehicle.in_failsafe or not state.pilot.elsewhere
        if quiet:
            self._outbox.set_command(time_s, command)
        else:
            self._outbox.send_level(time_s, command)

    def _flown(self) -> Command:
        """The attitude that the vehicle has, with the thrust that its autopilot reports."""
        state = self._state
        attitude, share = state.vehicle.attitude, state.hover.thrust(state.time_s)
        assert attitude is not None
        direction = thrust_direction_from_quaternion(np.array(attitude.attitude))
        north, east, down = direction.tolist()
        model = state.model
        thrust_mps2 = (1.0 if share is None else share / model.hover_thrust) * model.gravity_mps2
        return Command(thrust_mps2, (north, east, down), state.vehicle.course_rad)

    def request_parameters(self) -> None:
        """In HEALTH: ask what decides whether the vehicle can be flown; it needs no telemetry."""
        state = self._state
        due = state.reading.due(self._dialect, state.vehicle.parameters, state.now_s)
        self._outbox.send(*due)
        if state.service:
            if state.vehicle.uid is None:
                self._outbox.request(CommandLong.message(AUTOPILOT_VERSION))
            return
        stale = state.vehicle.mode == self._dialect.engage_mode and state.vehicle.disarmed
        if stale and not state.vehicle.prearm_ok:  # PX4 returns to OFFBOARD after a landing
            self._outbox.request(self._dialect.hold())

    def _fit_telemetry(self, in_phase_s: float) -> None:
        """Request less telemetry while the link delays by more than can be flown: it may be
        saturated."""
        link, limits = self._state.clock.delay, self._state.limits
        if in_phase_s - self._fitted_s < FIT_EVERY_S or link is None:
            return
        if link.value > limits.link_delay_s or link.sd > limits.link_jitter_s:
            self._fitted_s = in_phase_s
            if self._session.thin_telemetry():
                self._state.clock.measure_delay_again()
                delay = f"{1e3 * link.value:.0f} +- {1e3 * link.sd:.0f} ms"
                self._outbox.announce(f"the link delays by {delay}: less telemetry is requested")

    def _take_off(self, tick: Tick) -> None:
        if self._state.takes_off_by_command:
            self._request_takeoff(tick.time_s)
            return
        age_s, most = self._state.vehicle.position_age_s, SPOOL_MAX
        rising_s = tick.in_phase_s
        if age_s > SPOOL_KNOWN_S:
            rising_s, most = rising_s - age_s, SPOOL_UNSEEN
        spool = min(most, max(0.0, SPOOL_UP_PER_S * rising_s))
        thrust_mps2 = spool * self._state.model.gravity_mps2
        course_rad = self._outbox.command.course_rad
        self._outbox.send_level(tick.time_s, Command(thrust_mps2, LEVEL, course_rad))

    def _request_takeoff(self, time_s: float) -> None:
        """The autopilot takes off. No setpoint is sent: without thrust it would cancel that.

        The autopilot's thrust is close to hover thrust; the observer needs it for the take-over.
        """
        self._outbox.request(self._dialect.take_off(TAKEOFF_HEIGHT_M))
        gravity_mps2 = self._state.model.gravity_mps2
        course_rad = self._state.vehicle.course_rad
        self._outbox.set_command(time_s, Command(gravity_mps2, LEVEL, course_rad))

    def _level(self) -> Command:
        """Level, with the thrust that hovers. Before lift-off is seen, with the thrust reached, but
        less than lifts."""
        flying, command = self._state.plan.reference is not None, self._outbox.command
        least_mps2 = SPOOL_UNSEEN * self._state.model.gravity_mps2
        thrust_mps2 = min(command.thrust_mps2, least_mps2)
        if flying:
            thrust_mps2 = self._outbox.hover_mps2()
        return Command(thrust_mps2, LEVEL, command.course_rad)

    @property
    def _dialect(self) -> Dialect:
        assert self._state.dialect is not None
        return self._state.dialect
