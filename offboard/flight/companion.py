"""The companion computer, without I/O: received bytes and times in, frames out. Flies one flight.

One turn takes all that has arrived, in order; then, if vehicle time has crossed a multiple of the
control period, it decides once, on the newest state: `phase_machine` makes the transitions that are
due, and `actions` does what the phase requires (`decide` while tracking). Frames are queued in
`outbox`. What no setpoint waits for comes in `finish_turn`: records and identification.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence

from offboard.control.base import Adopting, Controller
from offboard.estimation.observer import Observer
from offboard.flight.actions import PhaseActions
from offboard.flight.authority import Standing
from offboard.flight.busyness import PAUSE_S, Busyness
from offboard.flight.decide import Decider, Tick
from offboard.flight.event_processor import EventProcessor
from offboard.flight.flight_plan import FlightPlan
from offboard.flight.inputs import InputRecorder
from offboard.flight.news import News
from offboard.flight.online_identification import IdentifySettings, OnlineIdentification
from offboard.flight.outbox import Outbox, Output
from offboard.flight.phase_machine import PhaseMachine
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
from offboard.flight.snapshot import Snapshot, snapshot_of
from offboard.flight.state import FlightState, Outcome
from offboard.identification.learner import Learned
from offboard.link.interface import Chunk
from offboard.mavlink.dialects.base import NEVER
from offboard.mavlink.events import (
    Attitude,
    ClockBehind,
    Event,
    LocalPosition,
    Rebooted,
)
from offboard.mavlink.outgoing import Outgoing
from offboard.mavlink.session import ACTIVE, Session
from offboard.model.vehicle import Vehicle
from offboard.supervisor.supervisor import Supervised

__all__ = ["STOPPED", "Companion", "Outcome", "Output"]

MAV_STATE_STANDBY, MAV_STATE_CRITICAL = 3, 5
BRIDGED_SHARE = 0.3  # of `Limits.silence_s`; after it, level setpoints replace the control law


class Companion:
    """Flies `plan` with `controller`. `stopwatch` reads host time.

    `deadline_s` is the wall time that one decision may take; None in lockstep, where the vehicle
    waits for each decision. `learned` is what an earlier flight has identified of the vehicle.
    `before` has ended or waits, with the same session: what it knows of vehicle and link stays
    known.

    `state` is the flight's state; `peer` the address that the vehicle sends from, None before it is
    found; `strangers` the datagrams of other senders, for the log.
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
        learned: Learned | None = None,
        service: ServiceOptions | None = None,
        before: Companion | None = None,
    ) -> None:
        self._session = session
        self._observer = observer
        self._period_s = period_s
        self._lockstep = session.settings.lockstep
        model = learned.vehicle if learned else vehicle
        if learned:
            observer.adopt(model)
        self._identification = _identification(vehicle, controller, identify, learned)
        self.state = state = FlightState(
            limits, plan, model, session, observer, self._identification, service
        )
        if before is not None:
            state.follow(before.state)
        state.busyness = Busyness(period_s)
        self.peer: Hashable | None = before.peer if before else None
        same_period = before is not None and before._period_s == period_s
        self._tick: int = before._tick if before and same_period else -1
        # host time of the last turn, and telemetry
        self._turned_s: float = before._turned_s if before else math.nan
        self._heard_s: float = before._heard_s if before else math.nan
        self._bridged_s = 0.0
        self._logged: list[bytes] = []  # frames since the newest `finish_turn`
        self._ticked = False  # in this turn
        self._news = News()
        self._inputs = InputRecorder(session.settings, kept=service is None)
        self.strangers: int = before.strangers if before else 0
        self._recorded_strangers = self.strangers
        self._outbox = Outbox(state, session, observer, self._identification)
        self._decider = decider = Decider(
            state=state,
            controller=controller,
            observer=observer,
            identification=self._identification,
            outbox=self._outbox,
            period_s=period_s,
            deadline_s=deadline_s,
            stopwatch=self._inputs.watch(stopwatch),
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
        self._events = EventProcessor(
            state=state,
            session=session,
            observer=observer,
            identification=self._identification,
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

    @property
    def announcements(self) -> int:
        """How many there were."""
        return len(self.announced)

    def snapshot(self) -> Snapshot:
        """The flight at this moment, for displays."""
        return snapshot_of(
            self.state,
            self._outbox.command,
            self.announced,
            self.strangers,
            self._session.counters.forged,
        )

    def has_ended(self) -> bool:
        """Whether the flight is over. After another has taken the vehicle, its next HEARTBEAT is
        awaited, as the log must have what it shows; nothing is sent to it any more."""
        return self.state.has_ended and not self.state.awaits_heartbeat

    @property
    def identification(self) -> OnlineIdentification | None:
        """What is identified in flight; None with a controller that cannot use it."""
        return self._identification

    def request_stop(self, why: str = STOPPED) -> None:
        """Land, or do not take off; takes effect at the next turn."""
        if not self.state.stop_reason:
            self._inputs.call("request_stop", why)
            self.state.stop_reason = why

    def announce(self, sentence: str) -> None:
        """Report a sentence to the user, the ground station and the log."""
        self._inputs.call("announce", sentence)
        self._outbox.announce(sentence)

    def guard(self, guarded: bool) -> None:
        """Whether a supervisor would land the vehicle if this process ended."""
        if guarded is not self.state.guarded:
            self._inputs.call("guard", guarded)
            self.state.guarded = guarded

    @property
    def lands_without_log(self) -> bool:
        """Whether a log that cannot be written ends the flight."""
        return self.state.limits.log_lost == "land"

    def on_dropped(self, frames: int) -> None:
        """The last frames of the newest `Output` were not sent: they became too old."""
        self._inputs.dropped(frames)
        self._news.dropped.add(frames)

    def overhear(self, datagrams: Sequence[bytes]) -> None:
        """Datagrams from other addresses than the vehicle's: on the ground, they may show that
        several vehicles send to us."""
        if self.phase in BEFORE_FLIGHT:
            for datagram in datagrams:
                for system_id in self._session.overhear(datagram):
                    self._inputs.call("note_autopilot", system_id)

    def note_autopilot(self, system_id: int) -> None:
        """Another address shows the autopilot of this system, for a replay."""
        self._session.senders.hear(system_id, self._session.link_time_s)

    def turn(self, chunks: Sequence[Chunk], now_s: float) -> Output:
        """Process all that has arrived, then act once if a tick is due. Returns what to send.

        Call it at least every 50 ms, and `finish_turn` after the frames were sent. `now_s` is host
        time.
        """
        before = self._tick
        now_s = self._inputs.begin(now_s, self.strangers)
        try:
            self._take_and_act(chunks, now_s)
        finally:
            self._inputs.end()
        self._ticked = self._tick != before
        output = self._outbox.flush(self._supervised())
        self._logged += output.send
        return output

    def finish_turn(self, sent_s: float) -> list[bytes]:
        """Do what no setpoint waits for: identify the vehicle, and encode the log's records.

        `sent_s`: host time at which the last frame of the turn was sent. Returns the frames for the
        log: received, sent, records. Sentences of the identification leave with the next turn.
        """
        self._decider.finish(sent_s)
        pieces = self._inputs.pieces(all_of_it=self._ticked or self.has_ended())
        logged, self._logged = self._logged, []
        return [*logged, *self._outbox.records(), *map(self._session.encode, pieces)]

    def _take_and_act(self, chunks: Sequence[Chunk], now_s: float) -> None:
        self._begin_turn(now_s)
        before_s = self.state.now_s
        replies: list[Outgoing] = []
        heard = False
        for chunk in chunks:
            arrived_s = self._inputs.arrived_s(chunk)
            reception = self._session.receive(chunk.data, chunk.peer, arrived_s)
            self._inputs.chunk(chunk, reception)
            if reception.events:
                self.peer = chunk.peer
            self._logged += reception.frames
            replies += reception.replies
            for event in reception.events:
                self._events.process(event, arrived_s, turned_s=now_s)
                heard |= self._is_telemetry(event)
                if isinstance(event, Rebooted):
                    self._on_reboot()
        news = self._session.counters.news()
        if news:
            self._outbox.announce(news)
        state = self.state
        self._session.status = self._status()
        due = self._session.poll(now_s)
        state.now_s = state.vehicle.now_s = self._session.link_time_s
        if state.phase is Phase.LAND and state.unreached_s:
            state.began_s += state.now_s - before_s  # a landing that is not seen takes no time
        state.host_s = self._session.clock_s(now_s)
        if heard:
            self._heard_s = self._session.elapsed_s(now_s)
            state.silence_s = self._bridged_s = 0.0
        self._act()
        for sentence in self._news.due(state, self._session, now_s):
            self._outbox.announce(sentence)
        self._outbox.send(*due, *replies)

    def _supervised(self) -> Supervised | None:
        """For the supervisor: whether it has to act, should this process fail."""
        state, vehicle = self.state, self._session.vehicle
        if vehicle is None:
            return None
        health, authority = state.vehicle.health, state.authority
        flies = state.phase not in BEFORE_FLIGHT and not state.has_ended
        return Supervised(
            vehicle,
            ours=flies and authority is not None and authority.is_ours,
            flying=state.vehicle.armed,
            reported_s=authority.arrived_s if authority else -math.inf,
            holding=state.phase is Phase.HOLD,
            loss=authority.loss if authority else NEVER,
            sticks=health is not None and health.radio_ok,
            starved=state.starved
            or (authority is not None and authority.standing is Standing.FAILSAFE),
        )

    def _status(self) -> tuple[int, int]:
        """MAV_STATE and custom_mode of our heartbeat."""
        phase, failsafe = self.state.phase, self.state.failsafe
        calm = phase in WAITING or phase in ENDS
        critical = phase in FLYING and failsafe.action >= Action.HOLD
        status = MAV_STATE_CRITICAL if critical else MAV_STATE_STANDBY if calm else ACTIVE
        return status, PHASE_CODES[phase]

    # ------------------------------------------------------------------ one turn

    def _begin_turn(self, now_s: float) -> None:
        state = self.state
        elapsed_s = self._session.elapsed_s(now_s)
        if math.isnan(self._turned_s):
            self._turned_s, self._heard_s = now_s, elapsed_s
        paused_s = now_s - self._turned_s
        self._turned_s = now_s
        state.host_s = self._session.clock_s(now_s)
        state.silence_s = elapsed_s - self._heard_s
        state.note_starvation()
        if paused_s > PAUSE_S and state.authority is not None and not self._lockstep:
            state.authority.doubt(now_s, paused_s)
            self._news.paused.add(paused_s)
        if not self._lockstep:
            state.busyness.on_turn(paused_s)

    def _act(self) -> None:
        """What is due after everything that arrived was processed."""
        state, silence_s = self.state, self.state.silence_s
        if state.vehicle.has_state and not state.has_ended:
            self._tick_if_due()
        timeout_s = min(state.limits.silence_s, state.limits.connect_s)
        if not state.vehicle.has_state or state.stop_reason or silence_s > timeout_s:
            self._machine.advance()
        if not state.vehicle.has_state and state.phase is Phase.HEALTH:
            self._actions.request_parameters()
        if not state.has_ended and silence_s > BRIDGED_SHARE * state.limits.silence_s:
            self._bridge(silence_s)
        if self.has_ended():
            self._machine.name_failsafe()

    def _is_telemetry(self, event: Event) -> bool:
        """Whether the event ends a silence. Once position and attitude are received only they do:
        without them vehicle time stands still and nothing is decided. After a reboot in flight both
        must be received again."""
        vehicle = self.state.vehicle
        if not vehicle.has_state:
            on_ground = self.state.phase in BEFORE_FLIGHT
            return on_ground and not isinstance(event, ClockBehind)
        return isinstance(event, (Attitude, LocalPosition)) and not vehicle.repeated

    def _on_reboot(self) -> None:
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
        pause_s = state.busyness.on_tick(missed, flying=state.phase in FLYING)
        self._machine.advance()
        if state.phase in FLYING:
            self._follow_link(time_s)
        if not state.has_ended:
            ignored = self.strangers + self._session.counters.forged
            self._actions.act(
                Tick(
                    time_s,
                    state.phase,
                    state.in_phase_s,
                    self._events.telemetry_arrived_s,
                    missed,
                    ignored - self._recorded_strangers,
                    pause_s,
                )
            )
            self._recorded_strangers = ignored
            self._outbox.send(state.clock.request(time_s, state.host_s))

    def _follow_link(self, time_s: float) -> None:
        growth = self.state.clock.growth
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
    vehicle: Vehicle,
    controller: Controller,
    settings: IdentifySettings | None,
    learned: Learned | None,
) -> OnlineIdentification | None:
    """None for a controller that cannot adopt another vehicle model."""
    if settings is None or not isinstance(controller, Adopting):
        return None
    return OnlineIdentification(vehicle, settings, learned=learned)
