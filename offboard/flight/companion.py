"""The companion computer, sans-I/O: datagrams and times in, frames out. It owns no socket or file.

One instance flies one flight. Telemetry goes to the view, the observer and the identification.
When vehicle time crosses a multiple of the control period, `phase_machine` advances the phase and
`actions` carries it out (`decide` while tracking). Every frame leaves through `outbox`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable

from offboard.control.base import Adopting, Controller
from offboard.estimation.fusion import FusedObserver
from offboard.estimation.observer import Observer
from offboard.flight.actions import PhaseActions
from offboard.flight.assessment import Assessment
from offboard.flight.decide import Decider, Tick
from offboard.flight.flight_plan import FlightPlan
from offboard.flight.link_delay import LinkDelay
from offboard.flight.online_identification import IdentifySettings, OnlineIdentification
from offboard.flight.outbox import Outbox, Output
from offboard.flight.phase_machine import Outcome, PhaseMachine
from offboard.flight.phases import Limits, Phase
from offboard.flight.readiness import Readiness
from offboard.flight.view import VehicleView
from offboard.mavlink.events import (
    Attitude,
    Event,
    GpsFix,
    LocalPosition,
    Moved,
    Origin,
    Reset,
    TimeAnswer,
)
from offboard.mavlink.session import Session
from offboard.model.vehicle import Vehicle

__all__ = ["Companion", "Outcome", "Output"]

# When the link's delay is asked for with every setpoint; later with every tenth, for the log
TIMED = (Phase.STREAM, Phase.ENGAGE, Phase.ARM, Phase.TAKEOFF)
TIMED_EVERY = 10
STOPPED = "stop requested by the operator"
BRIDGED_SHARE = 0.3  # of the longest silence, after which level setpoints bridge it


class Companion:
    """Flies `plan` with `controller`. `stopwatch` reads seconds, for solve times only."""

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
        learning: IdentifySettings | None = None,
    ) -> None:
        self._session = session
        self._observer = observer
        self._limits = limits
        self._period_s = period_s
        self._stopwatch = stopwatch
        self.plan = plan
        self.view = VehicleView()
        self.peer: Hashable | None = None  # where the vehicle's datagrams come from
        self._tick = -1
        self._bridged_s = 0.0
        self._identification = _identification(vehicle, controller, period_s, learning)
        self._outbox = Outbox(session, observer, vehicle, self._identification)
        self._link_delay = LinkDelay()
        readiness = Readiness()
        assessment = Assessment(self.view, session, plan, observer, readiness, limits)
        decider = Decider(
            controller=controller,
            observer=observer,
            plan=plan,
            assessment=assessment,
            identification=self._identification,
            outbox=self._outbox,
            deadline_s=deadline_s,
            stopwatch=stopwatch,
        )
        self._machine = PhaseMachine(
            view=self.view,
            session=session,
            plan=plan,
            observer=observer,
            assessment=assessment,
            decider=decider,
            identification=self._identification,
            outbox=self._outbox,
            link_delay=self._link_delay,
        )
        self._actions = PhaseActions(
            view=self.view,
            session=session,
            plan=plan,
            observer=observer,
            readiness=readiness,
            assessment=assessment,
            decider=decider,
            outbox=self._outbox,
        )

    # ------------------------------------------------------------------ the outside calls these

    @property
    def phase(self) -> Phase:
        return self._machine.phase

    @property
    def outcome(self) -> Outcome | None:
        """None while it flies."""
        return self._machine.outcome

    @property
    def announced(self) -> list[str]:
        """What the user is told, oldest first."""
        return self._outbox.announced

    def has_ended(self) -> bool:
        return self._machine.has_ended()

    def request_stop(self, why: str = STOPPED) -> None:
        """The vehicle shall be on the ground: obeyed at the next tick or poll."""
        self._machine.stop_reason = self._machine.stop_reason or why

    def receive(self, datagram: bytes, peer: Hashable, now_s: float) -> Output:
        """Take one datagram in, decide if it completes a tick, answer in order."""
        arrived_s = self._stopwatch()
        reception = self._session.receive(datagram, peer, now_s)
        if reception.events:
            self.peer = peer
        for event in reception.events:
            self._note(self._followed(event))
        alive = any(self._is_sign_of_life(event) for event in reception.events)
        if alive:
            self._machine.silence_s = self._bridged_s = 0.0
        if self.view.has_state and not self.has_ended():
            self._tick_if_due(arrived_s)
        self._outbox.pass_on(self._session.poll(now_s))
        if not self.view.has_state:
            self._machine.advance()
        for reply in reception.replies:
            self._outbox.send(reply)
        return self._outbox.take(reception.frames, alive)

    def poll(self, now_s: float, silence_s: float) -> Output:
        """Call when nothing arrives. `silence_s`: wall time since `Output.alive`."""
        machine = self._machine
        machine.silence_s = silence_s
        patience_s = min(self._limits.silence_s, self._limits.connect_s)
        if machine.stop_reason or silence_s > patience_s:
            machine.advance()
        if not self.has_ended() and silence_s > BRIDGED_SHARE * self._limits.silence_s:
            self._bridge(silence_s)
        self._outbox.pass_on(self._session.poll(now_s))
        return self._outbox.take((), False)

    # ------------------------------------------------------------------ telemetry in

    def _is_sign_of_life(self, event: Event) -> bool:
        """Whether the vehicle is heard: by its state once that flows, for without it vehicle time
        stands still and nothing is decided, whatever heartbeats say."""
        return isinstance(event, (Attitude, LocalPosition)) or not self.view.has_state

    def _followed(self, event: Event) -> Event:
        """The event with the position that counts: the vehicle's own, or that of our fusion."""
        if not isinstance(self._observer, FusedObserver):
            return event
        fusion = self._observer.fusion
        match event:
            case GpsFix(time_s, place, velocity, accuracy_m):
                fusion.on_fix(time_s, place, velocity, accuracy_m)
            case Origin(place, said):
                fusion.on_origin(place, said)
            case LocalPosition(time_s, position, speed):
                event = LocalPosition(time_s, *fusion.follow(time_s, position, speed))
        while fusion.news:
            self._outbox.announce(fusion.news.pop(0))
        return event

    def _note(self, event: Event) -> None:
        self.view.note(event)
        match event:
            case Attitude(time_s, attitude, rates):
                self._observer.on_attitude(time_s, attitude, rates)
                if self._identification:
                    self._identification.on_attitude(time_s, attitude)
            case LocalPosition(time_s, position, velocity):
                self._observer.on_position(time_s, position, velocity)
                if self._identification:
                    self._identification.on_position(time_s, position, velocity)
            case TimeAnswer():
                self._link_delay.note(event)
            case Moved(peer):
                self._outbox.announce(f"the vehicle is heard from another port now: {peer}")
            case Reset():
                self._observer.reset()
                self._link_delay.forget()
                self._tick = -1
                self._outbox.forget_asking()
                self._machine.note_reboot()

    # ------------------------------------------------------------------ ticks

    def _tick_if_due(self, arrived_s: float) -> None:
        time_s = self.view.time_s
        number = math.floor(time_s / self._period_s + 1e-6)
        if number <= self._tick:
            return
        missed = number - self._tick - 1 if self._tick >= 0 else 0
        self._tick = number
        self._machine.advance()
        if not self.has_ended():
            tick = Tick(time_s, self.phase, self._machine.in_phase_s, arrived_s, missed)
            self._actions.act(tick)
            if tick.phase in TIMED or number % TIMED_EVERY == 0:
                self._outbox.send(self._link_delay.question(time_s))

    def _bridge(self, silence_s: float) -> None:
        """Telemetry stopped: go on without, each period of wall time, until the table ends it."""
        if silence_s - self._bridged_s < self._period_s:
            return
        self._bridged_s = silence_s
        time_s = self.view.time_s + silence_s
        self._actions.hold(Tick(time_s, self.phase, self._machine.in_phase_s, math.nan))


def _identification(
    vehicle: Vehicle, controller: Controller, period_s: float, settings: IdentifySettings | None
) -> OnlineIdentification | None:
    """Nothing is learnt for a controller that could not take it over."""
    if settings is None or not isinstance(controller, Adopting):
        return None
    bandwidth = controller.bandwidth_radps
    return OnlineIdentification(vehicle, settings, period_s=period_s, bandwidth_radps=bandwidth)
