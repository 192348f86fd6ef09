"""The companion computer, without I/O: datagrams and times in, frames out. Flies one flight.

Telemetry goes to the vehicle state, the observer and the identification. When vehicle time crosses
a multiple of the control period, `phase_machine` makes the transitions that are due, and `actions`
does what the phase requires (`decide` while tracking). All frames are queued in `outbox`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence

from offboard.control.base import Adopting, Controller
from offboard.estimation.fusion import FusedObserver
from offboard.estimation.observer import Observer
from offboard.flight.actions import PhaseActions
from offboard.flight.assessment import Assessment
from offboard.flight.decide import Decider, Tick
from offboard.flight.flight_plan import FlightPlan
from offboard.flight.link import Chunk
from offboard.flight.link_delay import LinkDelay
from offboard.flight.online_identification import IdentifySettings, OnlineIdentification
from offboard.flight.outbox import Outbox, Output
from offboard.flight.phase_machine import Outcome, PhaseMachine
from offboard.flight.phases import BEFORE_FLIGHT, Limits, Phase
from offboard.flight.readiness import Readiness
from offboard.flight.state import VehicleState
from offboard.flight.supervisor import Guard
from offboard.mavlink.events import (
    Attitude,
    Event,
    GpsFix,
    LocalPosition,
    Origin,
    PeerChanged,
    Rebooted,
    TimesyncReply,
)
from offboard.mavlink.session import Session
from offboard.model.vehicle import Vehicle

__all__ = ["Companion", "Outcome", "Output"]

# Phases with a TIMESYNC request at every tick; later one at every tenth tick, for the log
MEASURE_DELAY = (Phase.STREAM, Phase.ENGAGE, Phase.ARM, Phase.TAKEOFF)
MEASURE_DELAY_EVERY = 10
STOPPED = "stop requested by the operator"
BRIDGED_SHARE = 0.3  # of `Limits.silence_s`; after it, level setpoints replace the control law


class Companion:
    """Flies `plan` with `controller`. `stopwatch` reads seconds, for solve times only.

    `state` is the vehicle's state; `peer` the address that it sends from, None before it is found.
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
        self._limits = limits
        self._period_s = period_s
        self._stopwatch = stopwatch
        self.plan = plan
        self.state = VehicleState()
        self.peer: Hashable | None = None
        self._tick = -1
        self._heard_s: float | None = None  # host time of the last telemetry
        self._bridged_s = 0.0
        self._identification = _identification(vehicle, controller, period_s, identify)
        self._outbox = Outbox(session, observer, vehicle, self._identification)
        self._link_delay = LinkDelay()
        readiness = Readiness()
        assessment = Assessment(self.state, session, plan, observer, readiness, limits)
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
            state=self.state,
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
            state=self.state,
            session=session,
            plan=plan,
            observer=observer,
            readiness=readiness,
            assessment=assessment,
            decider=decider,
            outbox=self._outbox,
        )

    # ------------------------------------------------------------------ interface

    @property
    def phase(self) -> Phase:
        return self._machine.phase

    @property
    def outcome(self) -> Outcome | None:
        """How the flight ended; None until then."""
        return self._machine.outcome

    @property
    def announced(self) -> list[str]:
        """Sentences for the user, oldest first."""
        return self._outbox.announced

    def has_ended(self) -> bool:
        return self._machine.has_ended()

    def request_stop(self, why: str = STOPPED) -> None:
        """Land, or do not take off; takes effect at the next tick or poll."""
        self._machine.stop_reason = self._machine.stop_reason or why

    def announce(self, sentence: str) -> None:
        """Report to the user, to the ground station and to the log."""
        self._outbox.announce(sentence)

    def turn(self, chunks: Sequence[Chunk], now_s: float) -> Output:
        """One turn of the loop: what has arrived until `now_s`, which may be nothing."""
        outputs: list[Output] = []
        for chunk in chunks:
            if not self.has_ended():
                outputs.append(self.receive(chunk.data, chunk.peer, now_s))
        if self._heard_s is None or any(output.alive for output in outputs):
            self._heard_s = now_s
        if not self.has_ended():
            outputs.append(self.poll(now_s, now_s - self._heard_s))
        return Output(
            tuple(frame for output in outputs for frame in output.send),
            tuple(frame for output in outputs for frame in output.log),
            self._guard(),
        )

    def _guard(self) -> Guard | None:
        vehicle, dialect = self._session.vehicle, self._session.dialect
        if vehicle is None or dialect is None:
            return None
        ours = self.phase not in BEFORE_FLIGHT and not self.has_ended()
        ours &= self.state.mode in (dialect.engage_mode, dialect.land_mode)
        return Guard(vehicle, ours, self.state.armed)

    def receive(self, datagram: bytes, peer: Hashable, now_s: float) -> Output:
        """Process one datagram from `peer` at host time `now_s`; decide if it completes a tick."""
        arrived_s = self._stopwatch()
        reception = self._session.receive(datagram, peer, now_s)
        if reception.events:
            self.peer = peer
        for event in reception.events:
            self._process(self._with_own_position(event))
        alive = any(self._is_telemetry(event) for event in reception.events)
        if alive:
            self._machine.silence_s = self._bridged_s = 0.0
        if self.state.has_state and not self.has_ended():
            self._tick_if_due(arrived_s)
        self._outbox.send(*reception.messages)
        if not self.state.has_state:
            self._machine.advance()
        return self._outbox.flush(reception.frames, alive)

    def poll(self, now_s: float, silence_s: float) -> Output:
        """Call this when nothing arrives. `silence_s`: wall time since `Output.alive`."""
        machine = self._machine
        machine.silence_s = silence_s
        timeout_s = min(self._limits.silence_s, self._limits.connect_s)
        if machine.stop_reason or silence_s > timeout_s:
            machine.advance()
        if not self.has_ended() and silence_s > BRIDGED_SHARE * self._limits.silence_s:
            self._bridge(silence_s)
        self._outbox.send(*self._session.poll(now_s))
        return self._outbox.flush((), False)

    # ------------------------------------------------------------------ telemetry

    def _is_telemetry(self, event: Event) -> bool:
        """Whether the event ends a silence. Once position and attitude are received only they do:
        without them vehicle time stands still and nothing is decided."""
        return isinstance(event, (Attitude, LocalPosition)) or not self.state.has_state

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

    def _process(self, event: Event) -> None:
        self.state.update(event)
        match event:
            case Attitude(time_s, attitude, rates):
                self._observer.on_attitude(time_s, attitude, rates)
                if self._identification:
                    self._identification.on_attitude(time_s, attitude)
            case LocalPosition(time_s, position, velocity):
                self._observer.on_position(time_s, position, velocity)
                if self._identification:
                    self._identification.on_position(time_s, position, velocity)
            case TimesyncReply():
                self._link_delay.on_reply(event)
            case PeerChanged(peer):
                self._outbox.announce(f"the vehicle now sends from another port: {peer}")
            case Rebooted():
                self._observer.reset()
                self._link_delay.reset()
                self._tick = -1
                self._outbox.restart_requests()
                self._machine.on_reboot()

    # ------------------------------------------------------------------ ticks

    def _tick_if_due(self, arrived_s: float) -> None:
        time_s = self.state.time_s
        number = math.floor(time_s / self._period_s + 1e-6)
        if number <= self._tick:
            return
        missed = number - self._tick - 1 if self._tick >= 0 else 0
        self._tick = number
        self._machine.advance()
        if not self.has_ended():
            tick = Tick(time_s, self.phase, self._machine.in_phase_s, arrived_s, missed)
            self._actions.act(tick)
            if tick.phase in MEASURE_DELAY or number % MEASURE_DELAY_EVERY == 0:
                self._outbox.send(self._link_delay.request(time_s))

    def _bridge(self, silence_s: float) -> None:
        """Without telemetry: a level setpoint each period of wall time, until a transition."""
        if silence_s - self._bridged_s < self._period_s:
            return
        self._bridged_s = silence_s
        time_s = self.state.time_s + silence_s
        self._actions.hold(Tick(time_s, self.phase, self._machine.in_phase_s, math.nan))


def _identification(
    vehicle: Vehicle, controller: Controller, period_s: float, settings: IdentifySettings | None
) -> OnlineIdentification | None:
    """None for a controller that cannot adopt another vehicle model."""
    if settings is None or not isinstance(controller, Adopting):
        return None
    bandwidth = controller.bandwidth_radps
    return OnlineIdentification(vehicle, settings, period_s=period_s, bandwidth_radps=bandwidth)
