"""One flight on the companion computer, without I/O: received bytes and times in, frames out.

`Flight.turn` takes all that has arrived, in order; then, if vehicle time has crossed a multiple of
the control period, it decides once, on the newest state. What no setpoint waits for comes in
`finish_turn`: records and identification.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

from offboard.control.base import Adaptive, Controller
from offboard.estimation.observer import Observer
from offboard.flight import actions, decision, outbox, telemetry, transitions
from offboard.flight.authority import Standing
from offboard.flight.busyness import PAUSE_S
from offboard.flight.display import News, Snapshot
from offboard.flight.flight_plan import FlightPlan
from offboard.flight.inputs import InputRecorder
from offboard.flight.phases import (
    BEFORE_FLIGHT,
    ENDS,
    FLYING,
    PHASE_CODES,
    STOPPED,
    WAITING,
    Action,
    Limits,
    Phase,
    ServiceOptions,
)
from offboard.flight.record import Tick
from offboard.flight.state import FlightState, Outcome
from offboard.identification.learner import IdentifySettings, Learner
from offboard.identification.vehicle_estimate import IdentifiedVehicle
from offboard.link.interface import Chunk
from offboard.mavlink.dialects.base import NEVER
from offboard.mavlink.events import Attitude, ClockBehind, Event, LocalPosition, Rebooted
from offboard.mavlink.outgoing import Outgoing
from offboard.mavlink.session import ACTIVE, Session
from offboard.model.vehicle import Vehicle
from offboard.supervisor.recovery import Supervised

__all__ = ["STOPPED", "Flight", "Outcome", "Output"]

MAV_STATE_STANDBY, MAV_STATE_CRITICAL = 3, 5
BRIDGED_SHARE = 0.3  # of `Limits.silence_s`; after it, level setpoints replace the control law


@dataclass(frozen=True, slots=True)
class Output:
    """What one turn sends."""

    send: tuple[bytes, ...] = ()
    supervised: Supervised | None = None  # for the supervisor; None before the vehicle is found


class Flight:
    """Flies `plan` with `controller`. `stopwatch` reads host time.

    `deadline_s` is the wall time that one decision may take; None in lockstep, where the vehicle
    waits for each decision. `known` is what an earlier flight has identified of the vehicle.
    `before` has ended or waits, with the same session: what it knows of vehicle and link stays
    known.

    `state` is the flight's state; `peer` the address that the vehicle sends from, None before it is
    found; `other_datagrams` the datagrams of other senders, for the log.
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
        known: IdentifiedVehicle | None = None,
        service: ServiceOptions | None = None,
        before: Flight | None = None,
    ) -> None:
        model = known.vehicle if known else vehicle
        if known:
            observer.set_vehicle(model)
        self._inputs = InputRecorder(session.settings, kept=service is None)
        self.state = FlightState(
            limits,
            plan,
            model,
            session,
            observer,
            controller,
            period_s,
            self._inputs.watch(stopwatch),
            deadline_s,
            _identification(vehicle, controller, identify, known),
            service,
        )
        self.peer: Hashable | None = None
        self.other_datagrams = 0
        self._tick = -1  # number of the newest
        self._turned_s = math.nan  # host time of the newest turn
        if before is not None:
            self.state.follow(before.state)
            self.peer, self.other_datagrams = before.peer, before.other_datagrams
            self._turned_s = before._turned_s
            self._tick = before._tick if before.state.period_s == period_s else -1
        self._recorded_others = self.other_datagrams
        self._news = News()
        self._logged: list[bytes] = []  # frames since the newest `finish_turn`
        self._ticked = self._heard = False  # in this turn

    # ------------------------------------------------------------------ the turn

    def turn(self, chunks: Sequence[Chunk], now_s: float) -> Output:
        """Process all that has arrived, then act once if a tick is due. Returns what to send.

        Call it at least every 50 ms, and `finish_turn` after the frames were sent. `now_s` is host
        time.
        """
        flight = self.state
        self._ticked = self._heard = False
        now_s = self._inputs.begin(now_s, self.other_datagrams)
        try:
            before_s = flight.now_s
            self._begin_turn(now_s)
            replies = [reply for chunk in chunks for reply in self._receive(chunk, now_s)]
            due = self._poll(now_s, before_s)
            if self._begin_tick():
                transitions.advance(flight)
                self._follow_link()
                actions.act(flight)
            self._go_on_without_telemetry()
            for sentence in self._news.due(flight, flight.session, now_s):
                outbox.announce(flight, sentence)
            outbox.send(flight, *due, *replies)
        finally:
            self._inputs.end()
        output = Output(outbox.flush(flight), self._supervised())
        self._logged += output.send
        return output

    def finish_turn(self, sent_s: float) -> list[bytes]:
        """Do what no setpoint waits for: identify the vehicle, and encode the log's records.

        `sent_s`: host time at which the last frame of the turn was sent. Returns the frames for the
        log: received, sent, records. Sentences of the identification leave with the next turn.
        """
        flight = self.state
        decision.finish(flight, sent_s)
        pieces = self._inputs.pieces(all_of_it=self._ticked or self.has_ended())
        logged, self._logged = self._logged, []
        return [*logged, *outbox.log(flight), *map(flight.session.encode, pieces)]

    def _begin_turn(self, now_s: float) -> None:
        flight = self.state
        session, authority = flight.session, flight.authority
        elapsed_s = session.elapsed_s(now_s)
        if math.isnan(self._turned_s):
            self._turned_s, flight.heard_s = now_s, elapsed_s
        paused_s, self._turned_s = now_s - self._turned_s, now_s
        flight.host_s = session.clock_s(now_s)
        flight.silence_s = elapsed_s - flight.heard_s
        flight.note_starvation()
        if session.settings.lockstep:
            return
        if paused_s > PAUSE_S and authority is not None:
            authority.doubt(now_s, paused_s)
            self._news.paused.add(paused_s)
        flight.busyness.on_turn(paused_s)

    def _receive(self, chunk: Chunk, now_s: float) -> Sequence[Outgoing]:
        """Take what a chunk reports, in order. Returns replies of the session."""
        flight, arrived_s = self.state, self._inputs.arrived_s(chunk)
        reception = flight.session.receive(chunk.data, chunk.peer, arrived_s)
        self._inputs.chunk(chunk, reception)
        self._logged += reception.frames
        if reception.events:
            self.peer = chunk.peer
        for event in reception.events:
            telemetry.update(flight, event, arrived_s, turned_s=now_s)
            self._heard |= self._ends_silence(event)
            if isinstance(event, Rebooted):
                self._tick = -1
                transitions.on_reboot(flight)
        return reception.replies

    def _ends_silence(self, event: Event) -> bool:
        """Whether the event is telemetry. Once position and attitude are received only they are:
        without them vehicle time stands still and nothing is decided. After a reboot in flight both
        must be received again."""
        vehicle = self.state.vehicle
        if not vehicle.has_state:
            on_ground = self.state.phase in BEFORE_FLIGHT
            return on_ground and not isinstance(event, ClockBehind)
        return isinstance(event, (Attitude, LocalPosition)) and not vehicle.repeated

    def _poll(self, now_s: float, before_s: float) -> Sequence[Outgoing]:
        """The time at which this turn acts; returns what the session sends by itself."""
        flight, session = self.state, self.state.session
        news = session.counters.news()
        if news:
            outbox.announce(flight, news)
        session.status = self._status()
        due = session.poll(now_s)
        flight.now_s = flight.vehicle.now_s = session.link_time_s
        if flight.phase is Phase.LAND and flight.unreached_s:
            flight.began_s += flight.now_s - before_s  # a landing that is not seen takes no time
        flight.host_s = session.clock_s(now_s)
        if self._heard:
            flight.heard_s = session.elapsed_s(now_s)
            flight.silence_s = flight.bridged_s = 0.0
        return due

    def _begin_tick(self) -> bool:
        """Whether a multiple of the control period has been crossed."""
        flight = self.state
        if not flight.vehicle.has_state or flight.has_ended:
            return False
        number = math.floor(flight.time_s / flight.period_s + 1e-6)
        if number <= self._tick:
            return False
        missed = number - self._tick - 1 if self._tick >= 0 else 0
        self._tick, self._ticked = number, True
        pause_s = flight.busyness.on_tick(missed, flying=flight.phase in FLYING)
        ignored = self.other_datagrams + flight.session.counters.forged
        flight.tick = Tick(
            flight.time_s,
            flight.telemetry_arrived_s,
            missed,
            ignored - self._recorded_others,
            pause_s,
        )
        self._recorded_others = ignored
        return True

    def _follow_link(self) -> None:
        """The link may have become later: prediction and bandwidth take that into account."""
        flight = self.state
        growth, identification = flight.clock.growth, flight.identification
        if flight.phase not in FLYING or not growth.step(flight.time_s, flight.link_growth_s):
            return
        if identification:
            identification.on_link_growth(growth.added_s, growth.changed_s)

    def _go_on_without_telemetry(self) -> None:
        """What is due whether or not telemetry arrives: transitions, requests, and level setpoints,
        one in each period of host time until a transition."""
        flight, silence_s = self.state, self.state.silence_s
        limits, unknown = flight.limits, not flight.vehicle.has_state
        silent = silence_s > min(limits.silence_s, limits.connect_s)
        if unknown or flight.stop_reason or silent:
            transitions.advance(flight)
        if unknown and flight.phase is Phase.HEALTH:
            actions.request_parameters(flight)
        bridges = silence_s > BRIDGED_SHARE * limits.silence_s and not flight.has_ended
        if bridges and silence_s - flight.bridged_s >= flight.period_s:
            flight.bridged_s = silence_s
            actions.hold(flight, flight.time_s + silence_s)
        if self.has_ended():
            transitions.name_failsafe(flight)

    def _supervised(self) -> Supervised | None:
        """For the supervisor: whether it has to act, should this process fail."""
        flight, vehicle = self.state, self.state.session.vehicle
        if vehicle is None:
            return None
        health, authority = flight.vehicle.health, flight.authority
        flies = flight.phase not in BEFORE_FLIGHT and not flight.has_ended
        fails = authority is not None and authority.standing is Standing.FAILSAFE
        return Supervised(
            vehicle,
            ours=flies and authority is not None and authority.is_ours,
            flying=flight.vehicle.armed,
            reported_s=authority.arrived_s if authority else -math.inf,
            holding=flight.phase is Phase.HOLD,
            loss=authority.loss if authority else NEVER,
            sticks=health is not None and health.radio_ok,
            starved=flight.starved or fails,
        )

    def _status(self) -> tuple[int, int]:
        """MAV_STATE and custom_mode of our heartbeat."""
        phase, failsafe = self.state.phase, self.state.failsafe
        calm = phase in WAITING or phase in ENDS
        critical = phase in FLYING and failsafe.action >= Action.HOLD
        status = MAV_STATE_CRITICAL if critical else MAV_STATE_STANDBY if calm else ACTIVE
        return status, PHASE_CODES[phase]

    # ------------------------------------------------------------------ what others ask and say

    @property
    def current(self) -> Flight:
        """This flight, as the service has several."""
        return self

    @property
    def phase(self) -> Phase:
        return self.state.phase

    @property
    def outcome(self) -> Outcome | None:
        """How the flight ended; None until then."""
        return self.state.outcome

    def has_ended(self) -> bool:
        """Whether the flight is over. After another has taken the vehicle, its next HEARTBEAT is
        awaited, as the log must have what it shows; nothing is sent to it any more."""
        return self.state.has_ended and not self.state.awaits_heartbeat

    @property
    def identification(self) -> Learner | None:
        """What is identified in flight; None with a controller that cannot use it."""
        return self.state.identification

    @property
    def announced(self) -> list[str]:
        """Sentences for the user, oldest first."""
        return self.state.announced

    @property
    def announcements(self) -> int:
        """How many there were."""
        return len(self.announced)

    def snapshot(self, flights: int = 0) -> Snapshot:
        """The flight at this moment, for displays; `flights` that the service has begun."""
        return Snapshot(self.state, self.other_datagrams, flights)

    @property
    def lands_without_log(self) -> bool:
        """Whether a log that cannot be written ends the flight."""
        return self.state.limits.log_lost == "land"

    def request_stop(self, why: str = STOPPED) -> None:
        """Land, or do not take off; takes effect at the next turn."""
        if not self.state.stop_reason:
            self._inputs.call("request_stop", why)
            self.state.stop_reason = why

    def announce(self, sentence: str) -> None:
        """Report a sentence to the user, the ground station and the log."""
        self._inputs.call("announce", sentence)
        outbox.announce(self.state, sentence)

    def guard(self, guarded: bool) -> None:
        """Whether a supervisor would land the vehicle if this process ended."""
        if guarded is not self.state.guarded:
            self._inputs.call("guard", guarded)
            self.state.guarded = guarded

    def on_dropped(self, frames: int) -> None:
        """The last frames of the newest `Output` were not sent: they became too old."""
        self._inputs.dropped(frames)
        self._news.dropped.add(frames)

    def overhear(self, datagrams: Sequence[bytes]) -> None:
        """Datagrams from other addresses than the vehicle's: on the ground, they may show that
        several vehicles send to us."""
        if self.phase in BEFORE_FLIGHT:
            for datagram in datagrams:
                for system_id in self.state.session.overhear(datagram):
                    self._inputs.call("note_autopilot", system_id)

    def note_autopilot(self, system_id: int) -> None:
        """Another address shows the autopilot of this system, for a replay."""
        session = self.state.session
        session.senders.hear(system_id, session.link_time_s)


def _identification(
    vehicle: Vehicle,
    controller: Controller,
    settings: IdentifySettings | None,
    known: IdentifiedVehicle | None,
) -> Learner | None:
    """None for a controller that cannot use another vehicle model."""
    if settings is None or not isinstance(controller, Adaptive):
        return None
    return Learner(vehicle, settings, known=known)
