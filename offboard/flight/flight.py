"""One flight on the companion computer. No I/O: received bytes and times go in, frames come out."""

from __future__ import annotations

import math
from collections.abc import Sequence

from offboard.flight import actions, decision, outbox, telemetry, transitions
from offboard.flight.authority import Standing
from offboard.flight.display import News, Snapshot
from offboard.flight.phases import (
    BEFORE_FLIGHT,
    ENDS,
    FLYING,
    OPERATOR_STOP,
    WAITING,
    Action,
    Phase,
)
from offboard.flight.record import DROPPED, InputRecorder
from offboard.flight.state import FlightState
from offboard.flight.timing import PAUSE_S
from offboard.link.interface import Chunk
from offboard.mavlink.events import CRITICAL, Attitude, ClockBehind, Event, LocalPosition, Rebooted
from offboard.mavlink.outgoing import Outgoing
from offboard.mavlink.session import ACTIVE
from offboard.supervisor.recovery import Supervised

STATE_STANDBY = 3  # MAV_STATE
# Share of `Limits.silence_s` without telemetry, after which level setpoints replace the control law
BRIDGED_SHARE = 0.3


class Flight(FlightState):
    """The state of one flight, and the turn that the loop calls. If `before` is given, a flight of
    the same session that has ended or waits, this flight begins with what `before` knows about
    the vehicle and the link."""

    def __post_init__(self, before: FlightState | None) -> None:
        super().__post_init__(before)
        self._inputs = InputRecorder(self.session.settings, kept=self.service is None)
        self.stopwatch = self._inputs.watch(self.stopwatch)
        self._tick = -1  # number of the newest tick; -1 before the first
        self._recorded_others = self.other_datagrams
        self._news = News()
        self._logged: list[bytes] = []  # frames for the log since the newest `finish_turn`
        self._ticked = self._heard = False  # whether this turn had a tick, and telemetry
        self._setpoint_before_s = self.setpoint_s  # its value before this turn

    # ------------------------------------------------------------------ the turn

    def turn(self, chunks: Sequence[Chunk], host_now_s: float) -> tuple[bytes, ...]:
        """Process all that has arrived, then act once if a control tick is due. Returns the frames
        to send.

        Call it at least every 50 ms, and `finish_turn` after the frames were sent. `host_now_s` is
        host time. In lockstep a turn without chunks does nothing, because the number of such turns
        between two barriers depends on the load of the machine.
        """
        self._ticked = self._heard = False
        self._setpoint_before_s = self.setpoint_s
        if self.session.settings.lockstep and not chunks:
            return ()
        host_now_s = self._inputs.begin(host_now_s, self.other_datagrams)
        try:
            before_s = self.now_s
            self._begin_turn(host_now_s)
            replies = [reply for chunk in chunks for reply in self._receive(chunk, host_now_s)]
            due = self._poll(host_now_s, before_s)
            if self._begin_tick():
                transitions.advance(self)
                self._follow_link()
                actions.act(self)
            else:
                outbox.repeat_setpoint(self)
            self._go_on_without_telemetry()
            for sentence in self._news.due(self, host_now_s):
                outbox.announce(self, sentence)
            if self.in_end_phase and self.service and self.busyness.sentence:
                outbox.announce(self, self.busyness.sentence, once=True)
            outbox.send(self, *due, *replies)
        finally:
            self._inputs.end()
        # after the turn was recorded: a replay has these datagrams only as calls
        self.overhear([each.data for each in chunks if self.session.peer not in (None, each.peer)])
        frames = outbox.flush(self)
        self._logged += frames
        return frames

    def finish_turn(self, sent_s: float) -> list[bytes]:
        """Do the work that must not delay a setpoint: identify the vehicle, and encode the records.

        `sent_s` is the host time at which the last frame of the turn was sent. Returns the frames
        for the log: received frames, sent frames and records. Announcements of the identification
        are sent in the next turn.
        """
        decision.finish(self, sent_s)
        pieces = self._inputs.pieces(all_of_it=self._ticked or self.has_ended())
        logged, self._logged = self._logged, []
        return [*logged, *outbox.log(self), *map(self.session.encode, pieces)]

    def _begin_turn(self, host_now_s: float) -> None:
        session = self.session
        before_s, self.host_s = self.host_s, session.elapsed_s(host_now_s)
        if math.isnan(before_s):
            before_s = self.telemetry_host_s = self.host_s
        paused_s = self.host_s - before_s
        self.note_missing_setpoints()
        session.senders.roams = bool(self.service) and self.silent_since_health
        if session.settings.lockstep:
            return
        if paused_s > PAUSE_S and self.authority.engage_mode:
            self.authority.doubt(host_now_s, paused_s)
            self._news.paused.add(paused_s)
        self.busyness.on_turn(paused_s)

    def _receive(self, chunk: Chunk, host_now_s: float) -> Sequence[Outgoing]:
        """Process the events in a chunk, in order. Returns the replies of the session."""
        arrived_s = self._inputs.arrived_s(chunk)
        reception = self.session.receive(chunk.data, chunk.peer, arrived_s)
        self._inputs.chunk(chunk, reception)
        self._logged += reception.frames
        for event in reception.events:
            if telemetry.is_of_another(self, event):
                outbox.announce(self, "another vehicle answers, with the same system id")
                self._take(Rebooted(), arrived_s, host_now_s)
            self._take(event, arrived_s, host_now_s)
        return reception.replies

    def _take(self, event: Event, arrived_s: float, host_now_s: float) -> None:
        is_news = telemetry.update(self, event, arrived_s, turned_s=host_now_s)
        self._heard |= is_news and self._ends_silence(event)
        if isinstance(event, Rebooted):
            self._tick = -1

    def _ends_silence(self, event: Event) -> bool:
        """Whether the event counts as telemetry, which ends a silence. On the ground any event
        counts until both position and attitude were received. From then on only these two count,
        because without them vehicle time does not advance and nothing is decided. After a reboot in
        flight nothing counts until both were received again."""
        if not self.vehicle.has_state:
            return self.phase in BEFORE_FLIGHT and not isinstance(event, ClockBehind)
        return isinstance(event, (Attitude, LocalPosition))

    def _poll(self, host_now_s: float, before_s: float) -> Sequence[Outgoing]:
        """Set the link time of this turn. Returns the messages that the session sends by itself."""
        session = self.session
        news = session.senders.news()
        if news:
            outbox.announce(self, news)
        due = session.poll(host_now_s, self._status())
        self.vehicle.now_s = session.link_time_s
        if self.phase is Phase.LAND and self.unreached_s:
            # `limits.land_s` does not run while the vehicle is not heard
            self.began_s += self.now_s - before_s
        if self._heard:
            self.telemetry_host_s = session.elapsed_s(host_now_s)
            self.bridged_s = 0.0
        return due

    def _begin_tick(self) -> bool:
        """Whether a multiple of the control period has been crossed."""
        if not self.vehicle.has_state or self.in_end_phase:
            return False
        number = math.floor(self.time_s / self.period_s + 1e-6)
        if number <= self._tick:
            return False
        skipped = number - self._tick - 1 if self._tick >= 0 else 0
        self._tick, self._ticked = number, True
        self.busyness.on_tick(skipped, flying=self.phase in FLYING)
        ignored = self.other_datagrams + self.session.senders.forged.total()
        self.ignored, self._recorded_others = ignored - self._recorded_others, ignored
        return True

    def _follow_link(self) -> None:
        """Measure the growth of the link delay, for the prediction and the bandwidth."""
        growth, growth_s = self.clock.growth, max(self.clock.delay_growth_s, self.age_s)
        changed = self.phase in FLYING and growth.step(self.time_s, growth_s)
        if changed and self.identification:
            self.identification.on_link_growth(growth.added_s, growth.changed_s)

    def _go_on_without_telemetry(self) -> None:
        """Do what is due without telemetry: transitions, requests for parameters, and after
        BRIDGED_SHARE of `limits.silence_s` the requests and level setpoints of
        `actions.act_without_decision`, once in each control period of host time."""
        silence_s, limits, unknown = self.silence_s, self.limits, not self.vehicle.has_state
        silent = silence_s > min(limits.silence_s, limits.connect_s)
        if unknown or self.stop_reason or silent:
            transitions.advance(self)
        if unknown and self.phase is Phase.HEALTH:
            actions.request_parameters(self)
        bridges = silence_s > BRIDGED_SHARE * limits.silence_s and not self.in_end_phase
        if bridges and silence_s - self.bridged_s >= self.period_s:
            self.bridged_s = silence_s
            actions.act_without_decision(self, self.time_s + silence_s)
        if self.has_ended():
            transitions.name_failsafe(self)

    @property
    def supervised(self) -> Supervised | None:
        """What the supervisor must know to decide whether it acts if this process fails. None
        before the vehicle is found."""
        found, health, authority = self.session.vehicle, self.vehicle.health, self.authority
        if found is None:
            return None
        missing = self.setpoints_missing or authority.standing is Standing.FAILSAFE
        return Supervised(
            found,
            ours=self.phase not in BEFORE_FLIGHT | ENDS and authority.is_ours,
            flying=self.vehicle.armed,
            reported_s=authority.arrived_s,
            holding=self.phase is Phase.HOLD,
            landing=self.phase is Phase.LAND,
            setpoint_loss=authority.setpoint_loss,
            sticks=health is not None and health.radio_ok,
            setpoint_s=-math.inf if missing else self.setpoint_s,
        )

    def _status(self) -> tuple[int, int]:
        """MAV_STATE and custom_mode of our heartbeat."""
        calm = self.phase in WAITING | ENDS
        critical = self.phase in FLYING and self.failsafe.action >= Action.HOLD
        status = CRITICAL if critical else STATE_STANDBY if calm else ACTIVE
        return status, self.phase.code

    # ------------------------------------------------------------------ what others ask and say

    @property
    def current(self) -> Flight:
        """This flight. The loop reads the same property of the service, which has several."""
        return self

    def has_ended(self) -> bool:
        """Whether the flight is over. If someone else has taken the vehicle, the flight first waits
        for the next HEARTBEAT, so that it is in the log; nothing is sent to the vehicle any more.
        """
        return self.in_end_phase and not self.awaits_heartbeat

    def snapshot(self, flights: int = 0) -> Snapshot:
        """The present values, for displays. `flights`: how many the service has begun."""
        return Snapshot(self, flights)

    def request_stop(self, why: str = OPERATOR_STOP) -> None:
        """Land, or do not take off. This takes effect at the next turn."""
        if not self.stop_reason:
            self._inputs.call("request_stop", why)
            self.stop_reason = why
            if self.phase is Phase.LAND:
                outbox.announce(self, f"{why}: the vehicle is landing already")

    def announce(self, sentence: str) -> None:
        """Report a sentence to the user, the ground station and the log."""
        self._inputs.call("announce", sentence)
        outbox.announce(self, sentence)

    def guard(self, guarded: bool) -> None:
        """Note whether a supervisor would land the vehicle if this process ended."""
        if guarded is not self.guarded:
            self._inputs.call("guard", guarded)
            self.guarded = guarded

    def on_dropped(self, frames: int) -> None:
        """Note that the last `frames` frames of the newest turn were too old and were not sent."""
        self._inputs.note(DROPPED, frames)
        self.setpoint_s, self.newest_setpoint = self._setpoint_before_s, None
        self._news.dropped.add(frames)

    def overhear(self, datagrams: Sequence[bytes]) -> None:
        """Look for autopilots in datagrams from other addresses than the vehicle's. On the ground
        they show whether several vehicles send to us."""
        senders = self.session.senders
        if self.phase in BEFORE_FLIGHT:
            for datagram in datagrams:
                for system_id in senders.overhear(datagram, self.session.link_time_s):
                    self._inputs.call("note_autopilot", system_id)

    def note_autopilot(self, system_id: int) -> None:
        """Note that another address sends as an autopilot with this system id. A replay calls it in
        place of `overhear`."""
        self.session.senders.hear_elsewhere(system_id, self.session.link_time_s)
