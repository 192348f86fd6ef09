"""The companion computer, without I/O: received bytes and times in, frames out. Flies one flight.

One turn takes all that has arrived, in order; then, if vehicle time has crossed a multiple of the
control period, it decides once, on the newest state: `phase_machine` makes the transitions that are
due, and `actions` does what the phase requires (`decide` while tracking). Frames are queued in
`outbox`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence

from offboard.control.base import Adopting, Controller
from offboard.estimation.fusion import FusedObserver
from offboard.estimation.observer import Observer
from offboard.flight.actions import PhaseActions
from offboard.flight.authority import Authority
from offboard.flight.decide import Decider, Tick
from offboard.flight.flight_plan import FlightPlan
from offboard.flight.ground_contact import GroundContact
from offboard.flight.link import Chunk
from offboard.flight.online_identification import IdentifySettings, OnlineIdentification
from offboard.flight.outbox import Outbox, Output
from offboard.flight.phase_machine import PhaseMachine
from offboard.flight.phases import BEFORE_FLIGHT, FLYING, Limits, Phase
from offboard.flight.state import FlightState, Outcome
from offboard.flight.supervisor import Guard
from offboard.mavlink.events import (
    Attitude,
    Event,
    GpsFix,
    Heartbeat,
    LocalPosition,
    ModeReport,
    Origin,
    PeerChanged,
    Rebooted,
    ThrustReport,
    TimesyncReply,
)
from offboard.mavlink.outgoing import Outgoing
from offboard.mavlink.session import Session
from offboard.model.vehicle import Vehicle

__all__ = ["Companion", "Outcome", "Output"]

STOPPED = "stop requested by the operator"
BRIDGED_SHARE = 0.3  # of `Limits.silence_s`; after it, level setpoints replace the control law
PAUSE_S = 0.3  # a longer gap between two turns: what was known before it is not known any more


class Companion:
    """Flies `plan` with `controller`. `stopwatch` reads host time.

    `deadline_s` is the wall time that one decision may take; None in lockstep, where the vehicle
    waits for each decision. `state` is the flight's state; `peer` the address that the vehicle
    sends from, None before it is found; `strangers` the datagrams of other senders, for the log.
    """

    def __init__(
        self,
        *,
        vehicle: Vehicle,
        session: Session,
        observer: Observer,
        controller: Controller,
        plan: FlightPlan,
        limits: Limits,
        period_s: float,
        deadline_s: float | None,
        stopwatch: Callable[[], float],
        identify: IdentifySettings | None = None,
    ) -> None:
        self._session = session
        self._observer = observer
        self._period_s = period_s
        self._lockstep = session.settings.lockstep
        self.state = state = FlightState(limits, plan, vehicle)
        self.peer: Hashable | None = None
        self._tick = -1
        self._turned_s = self._heard_s = math.nan  # host time of the last turn, and telemetry
        self._arrived_s = 0.0  # host time of the arrival of the newest telemetry
        self._bridged_s = 0.0
        self.strangers = self._recorded_strangers = 0
        self._identification = _identification(vehicle, controller, period_s, identify)
        self._outbox = Outbox(state, session, observer, self._identification)
        decider = Decider(
            state=state,
            controller=controller,
            observer=observer,
            identification=self._identification,
            outbox=self._outbox,
            period_s=period_s,
            deadline_s=deadline_s,
            stopwatch=stopwatch,
        )
        self._machine = PhaseMachine(
            state=state,
            session=session,
            observer=observer,
            decider=decider,
            identification=self._identification,
            outbox=self._outbox,
        )
        self._actions = PhaseActions(
            state=state,
            session=session,
            observer=observer,
            decider=decider,
            outbox=self._outbox,
        )

    # ------------------------------------------------------------------ interface

    @property
    def phase(self) -> Phase:
        return self.state.phase

    @property
    def outcome(self) -> Outcome | None:
        """How the flight ended; None until then."""
        return self.state.outcome

    @property
    def announced(self) -> list[str]:
        """Sentences for the user, oldest first."""
        return self._outbox.announced

    def has_ended(self) -> bool:
        return self.state.has_ended

    def request_stop(self, why: str = STOPPED) -> None:
        """Land, or do not take off; takes effect at the next turn."""
        self.state.stop_reason = self.state.stop_reason or why

    def announce(self, sentence: str) -> None:
        """Report a sentence to the user, the ground station and the log."""
        self._outbox.announce(sentence)

    def turn(self, chunks: Sequence[Chunk], now_s: float) -> Output:
        """Process all that has arrived, then act once if a tick is due.

        Call it at least every 50 ms. `now_s` is host time.
        """
        self._begin_turn(now_s)
        frames: list[bytes] = []
        replies: list[Outgoing] = []
        heard = False
        for chunk in chunks:
            reception = self._session.receive(chunk.data, chunk.peer, chunk.arrived_s)
            if reception.events:
                self.peer = chunk.peer
            frames += reception.frames
            replies += reception.replies
            for event in reception.events:
                heard |= self._is_telemetry(event)
                self._process(self._with_own_position(event), chunk.arrived_s)
        due = self._session.poll(now_s)
        state = self.state
        state.now_s = state.vehicle.now_s = self._session.link_time_s
        state.host_s = self._clock_s(now_s)
        if heard:
            self._heard_s, state.silence_s, self._bridged_s = now_s, 0.0, 0.0
        self._act()
        self._outbox.send(*due, *replies)
        return self._outbox.flush(frames, self._guard())

    def _guard(self) -> Guard | None:
        """For the supervisor: whether it has to act, should this process fail."""
        state, vehicle = self.state, self._session.vehicle
        if vehicle is None:
            return None
        ours = state.phase not in BEFORE_FLIGHT and not state.has_ended and state.may_command
        return Guard(vehicle, ours, state.vehicle.armed, holding=state.phase is Phase.HOLD)

    # ------------------------------------------------------------------ one turn

    def _begin_turn(self, now_s: float) -> None:
        state = self.state
        if math.isnan(self._turned_s):
            self._turned_s = self._heard_s = now_s
        paused_s = now_s - self._turned_s
        self._turned_s = now_s
        state.host_s = self._clock_s(now_s)
        state.silence_s = now_s - self._heard_s
        if paused_s > PAUSE_S and state.authority is not None and not self._lockstep:
            state.authority.doubt(now_s)
            self._outbox.announce(
                f"this computer paused for {paused_s:.2f} s: waiting for the vehicle's mode"
            )

    def _act(self) -> None:
        """What is due after everything that arrived was processed."""
        state, silence_s = self.state, self.state.silence_s
        if state.vehicle.has_state and not state.has_ended:
            self._tick_if_due()
        timeout_s = min(state.limits.silence_s, state.limits.connect_s)
        if not state.vehicle.has_state or state.stop_reason or silence_s > timeout_s:
            self._machine.advance()
        if not state.has_ended and silence_s > BRIDGED_SHARE * state.limits.silence_s:
            self._bridge(silence_s)

    def _is_telemetry(self, event: Event) -> bool:
        """Whether the event ends a silence. Once position and attitude are received only they do:
        without them vehicle time stands still and nothing is decided."""
        return isinstance(event, (Attitude, LocalPosition)) or not self.state.vehicle.has_state

    # ------------------------------------------------------------------ telemetry

    def _with_own_position(self, event: Event) -> Event:
        """The event; with `estimate: fused` a position is replaced by that of our own fusion."""
        if not isinstance(self._observer, FusedObserver):
            return event
        fusion = self._observer.fusion
        match event:
            case GpsFix(time_s, place, velocity, accuracy_m):
                fusion.on_fix(time_s, place, velocity, accuracy_m)
            case Origin(place, reported):
                fusion.on_origin(place, reported)
            case LocalPosition(time_s, position, speed):
                event = LocalPosition(time_s, *fusion.follow(time_s, position, speed))
        while fusion.news:
            self._outbox.announce(fusion.news.pop(0))
        return event

    def _process(self, event: Event, arrived_s: float) -> None:
        state = self.state
        state.now_s = self._session.link_time_s
        state.vehicle.update(event, state.now_s)
        match event:
            case Attitude(time_s, attitude, rates):
                self._on_telemetry(time_s, arrived_s)
                self._observer.on_attitude(time_s, attitude, rates)
                if self._identification:
                    self._identification.on_attitude(time_s, attitude)
            case LocalPosition(time_s, position, velocity) if event is state.vehicle.position:
                self._on_telemetry(time_s, arrived_s)
                state.contact.on_position(event)
                state.hover.on_position(time_s, state.contact.height_m, velocity[2])
                if state.touchdown:
                    state.touchdown.on_position(time_s, position, velocity[2])
                self._observer.on_position(time_s, position, velocity)
                if self._identification:
                    self._identification.on_position(time_s, position, velocity)
            case ThrustReport(thrust):
                state.hover.on_thrust(state.time_s, thrust)
            case Heartbeat(mode) | ModeReport(mode):
                self._on_mode(mode, arrived_s)
            case TimesyncReply():
                state.link.on_reply(event)
            case PeerChanged(peer):
                self._outbox.announce(f"the vehicle now sends from another port: {peer}")
            case Rebooted():
                self._on_reboot()

    def _on_telemetry(self, stamp_s: float, arrived_s: float) -> None:
        self._arrived_s = arrived_s
        # A stream says only how early it may have arrived: after a pause of ours it would be ahead
        host_s = self._turned_s if self._session.settings.stream else arrived_s
        self.state.clock.on_telemetry(stamp_s, self._clock_s(host_s))

    def _clock_s(self, host_s: float) -> float:
        """Host time; in lockstep, where host time must decide nothing, the link's own seconds."""
        return self._session.link_time_s if self._lockstep else host_s

    def _on_mode(self, mode: str, arrived_s: float) -> None:
        state = self.state
        if state.authority is None:
            state.dialect = self._session.dialect
            assert state.dialect is not None
            state.authority = Authority(state.dialect.engage_mode)
        state.authority.on_mode(
            mode, state.now_s, arrived_s=arrived_s, failsafe=state.vehicle.in_failsafe
        )

    def _on_reboot(self) -> None:
        state = self.state
        self._observer.reset()
        state.link.reset()
        state.growth.reset()
        state.clock.reset()
        state.contact = GroundContact(state.vehicle)
        state.authority = None
        self._tick = -1
        self._machine.on_reboot()

    # ------------------------------------------------------------------ ticks

    def _tick_if_due(self) -> None:
        state = self.state
        time_s = state.time_s
        number = math.floor(time_s / self._period_s + 1e-6)
        if number <= self._tick:
            return
        missed = number - self._tick - 1 if self._tick >= 0 else 0
        self._tick = number
        self._machine.advance()
        if state.phase in FLYING:
            self._follow_link(time_s)
        if not state.has_ended:
            self._actions.act(
                Tick(
                    time_s,
                    state.phase,
                    state.in_phase_s,
                    self._arrived_s,
                    missed,
                    self.strangers - self._recorded_strangers,
                )
            )
            self._recorded_strangers = self.strangers
            self._outbox.send(state.link.request(time_s))

    def _follow_link(self, time_s: float) -> None:
        growth = self.state.growth
        if growth.step(time_s, self.state.link_growth_s) and self._identification:
            self._identification.on_link_growth(growth.added_s, growth.changed_s)

    def _bridge(self, silence_s: float) -> None:
        """Without telemetry: a level setpoint each period of host time, until a transition."""
        if silence_s - self._bridged_s < self._period_s:
            return
        self._bridged_s = silence_s
        state = self.state
        time_s = state.time_s + silence_s
        self._actions.hold(Tick(time_s, state.phase, state.in_phase_s, math.nan))


def _identification(
    vehicle: Vehicle, controller: Controller, period_s: float, settings: IdentifySettings | None
) -> OnlineIdentification | None:
    """None for a controller that cannot adopt another vehicle model."""
    if settings is None or not isinstance(controller, Adopting):
        return None
    bandwidth = controller.bandwidth_radps
    return OnlineIdentification(vehicle, settings, period_s=period_s, bandwidth_radps=bandwidth)
