"""The listening pass: what is received and what is asked, until the observation is complete.

Sans-I/O: received chunks and host times in, frames out. It only asks: it never sends a setpoint, a
mode, an arming or a parameter, and no heartbeat: the vehicle may count on one, and says without it
what it says when no program of ours runs. Its component id is not that of a flight.
"""

from __future__ import annotations

import statistics
from collections.abc import Hashable, Iterable

from offboard.doctor.observation import ClockMeasures, LinkMeasures, Observation
from offboard.doctor.senders import Senders
from offboard.flight.preflight import FIX_3D, ParameterReading
from offboard.flight.vehicle_clock import VehicleClock
from offboard.flight.vehicle_state import VehicleState
from offboard.link.interface import Chunk
from offboard.mavlink.dialects.base import WantedMessage
from offboard.mavlink.events import (
    Attitude,
    ClockBehind,
    CommandAck,
    EstimatorReport,
    Event,
    GpsFix,
    LocalPosition,
    NoFix,
    Rebooted,
    TimesyncReply,
)
from offboard.mavlink.outgoing import CommandLong, Outgoing, Timesync
from offboard.mavlink.session import Session, SessionSettings
from offboard.mavlink.signing import Signing

DOCTOR_ID = 193  # MAV_COMP_ID_ONBOARD_COMPUTER3
NOTHING_S = 6.0  # without an autopilot
LEAST_S = 4.0  # with one, from when it was heard
LONGEST_S = 9.0
ASK_EVERY_S, TRIES = 1.0, 8
TIMESYNC_EVERY_S = 0.1
PREARM_AFTER_S = 1.0  # what is asked before may be lost: the link has just been opened
TEXTS_S = 1.0  # for the texts after the acknowledgement
ENOUGH = 0.7  # of a rate, measured over two seconds
SETTLE_S = 1.0  # until jumps of the vehicle's clock count
RUN_PREARM_CHECKS = 401  # MAV_CMD
VERSION, GPS, TIMESYNC = 148, 24, 111  # message ids


class Listening:
    """One pass over one link. `began_s`: host time. `system_id`: of the vehicle, if chosen.
    `sends_first`: the vehicle learns our address from what we send."""

    def __init__(
        self,
        began_s: float,
        *,
        system_id: int | None = None,
        signing: Signing | None = None,
        stream: bool = False,
        capacity_bytes_ps: float | None = None,
        sends_first: bool = False,
    ) -> None:
        self.peer: Hashable | None = None
        self.vehicle = VehicleState()
        self._began_s, self._found_s = began_s, 0.0
        self._sends_first = sends_first
        self._capacity_bytes_ps = capacity_bytes_ps
        self._session = Session(
            SessionSettings(
                system_id=system_id,
                component_id=DOCTOR_ID,
                stream=stream,
                capacity_bytes_ps=capacity_bytes_ps,
            ),
            signing,
        )
        self._senders = Senders(stream)
        self._parameters = ParameterReading(advice=True)
        self._clock = VehicleClock()
        self._asked: dict[int, tuple[int, float]] = {}  # message or command: tries, when
        self._settled = self._rebooted = self._requested = False
        self._may_greet = False  # a disarmed vehicle, whose signing time is behind ours
        self._late_s = 0.0
        self._sent_s: dict[int, float] = {}  # TIMESYNC: stamp -> when
        self._round_trips_s: list[float] = []
        self._timesync_s = self._foreign_timesync = 0.0
        self._first: tuple[float, float] | None = None  # vehicle time and host time
        self._newest: tuple[float, float] | None = None
        self._fix_type: int | None = None
        self._prearm_s: float | None = None  # when it was acknowledged
        self._acknowledged: dict[int, str] = {}

    # --- in ---

    def take(self, chunk: Chunk) -> None:
        """Process received bytes."""
        self._senders.receive(chunk.data, chunk.peer)
        if self.peer not in (None, chunk.peer):  # another vehicle, perhaps
            self._session.overhear(chunk.data)
        reception = self._session.receive(chunk.data, chunk.peer, chunk.arrived_s)
        for event in reception.events:
            if not self._found_s:
                self.peer = chunk.peer
            if not self._found_s and self._session.vehicle is not None:
                self._found_s = chunk.arrived_s
            self.vehicle.update(event, self._session.link_time_s)
            self._note(event, chunk.arrived_s)

    def _note(self, event: Event, at_s: float) -> None:
        match event:
            case Attitude(time_s) | LocalPosition(time_s):
                self._on_stamp(time_s, at_s)
            case TimesyncReply(request_ns):
                sent_s = self._sent_s.pop(request_ns, None)
                if sent_s is None:
                    self._foreign_timesync += 1
                else:
                    self._round_trips_s.append(at_s - sent_s)
                    self._clock.on_reply(event)
            case NoFix(fix_type):
                self._fix_type = fix_type
            case GpsFix():
                self._fix_type = FIX_3D
            case ClockBehind(armed=armed):
                self._may_greet = not armed
            case CommandAck(command, result):
                self._acknowledged[command] = result
                if command == RUN_PREARM_CHECKS and self._prearm_s is None:
                    self._prearm_s = at_s
            case Rebooted():
                self._rebooted = True
                self._first = self._newest = None
                self._clock = VehicleClock()

    def _on_stamp(self, stamp_s: float, at_s: float) -> None:
        self._late_s = max(self._late_s, self._clock.age_s(stamp_s, at_s) if self._settled else 0.0)
        self._clock.on_telemetry(stamp_s, at_s)
        if not self._settled and at_s - self._found_s > SETTLE_S:
            self._settled = True
            self._clock.settle()
        if self._first is None:
            self._first = stamp_s, at_s
        if self._newest is None or stamp_s > self._newest[0]:
            self._newest = stamp_s, at_s

    # --- out ---

    def due(self, now_s: float) -> list[bytes]:
        """The frames to send at host time `now_s`; call it at least every 50 ms."""
        return [self._session.encode(each) for each in self._questions(now_s)]

    def _questions(self, now_s: float) -> Iterable[Outgoing]:
        yield from filter(self._permitted, self._session.poll(now_s))
        dialect, state = self._session.dialect, self.vehicle
        if dialect is None:
            if (self._sends_first or self._may_greet) and self._may_ask(TIMESYNC, now_s):
                yield Timesync(0, round(now_s * 1e9))
            return
        yield from self._parameters.due(dialect, state.parameters, now_s)
        fix_age_s = min(state.age_s(NoFix), state.age_s(GpsFix))
        unknown = {
            VERSION: state.version is None,
            GPS: fix_age_s > ASK_EVERY_S,
            dialect.estimator_message: state.age_s(EstimatorReport) > ASK_EVERY_S,
        }
        for message_id, missing in unknown.items():
            if missing and self._may_ask(message_id, now_s):
                yield CommandLong.message(message_id)
        if self._prearm_due(now_s) and self._may_ask(RUN_PREARM_CHECKS, now_s):
            yield CommandLong.run_prearm_checks()
        if self._newest and now_s - self._timesync_s >= TIMESYNC_EVERY_S:
            self._timesync_s = now_s
            yield self._timesync(self._newest[0], now_s)

    def _permitted(self, outgoing: Outgoing) -> bool:
        """No heartbeats, and no rates for an armed vehicle, or before it is known."""
        known = self.vehicle.heartbeat is not None
        permitted = known and not self.vehicle.armed and isinstance(outgoing, CommandLong)
        self._requested |= permitted
        return permitted

    def _prearm_due(self, now_s: float) -> bool:
        disarmed = self.vehicle.heartbeat is not None and not self.vehicle.armed
        return disarmed and self._prearm_s is None and now_s - self._found_s >= PREARM_AFTER_S

    def _may_ask(self, number: int, now_s: float) -> bool:
        tries, asked_s = self._asked.get(number, (0, now_s - ASK_EVERY_S))
        if tries >= TRIES or now_s - asked_s < ASK_EVERY_S:
            return False
        self._asked[number] = tries + 1, now_s
        return True

    def _timesync(self, stamp_s: float, now_s: float) -> Timesync:
        request = self._clock.request(stamp_s, now_s)
        self._sent_s.setdefault(request.ts1_ns, now_s)
        return request

    # --- the end ---

    def complete(self, now_s: float) -> bool:
        """Everything was answered, or it takes too long."""
        state, passed_s = self.vehicle, now_s - self._began_s
        if self._session.vehicle is None or self._session.dialect is None:
            return passed_s >= NOTHING_S
        if now_s - self._found_s < LEAST_S or passed_s >= LONGEST_S:
            return passed_s >= LONGEST_S
        checked = state.armed or (self._prearm_s is not None and now_s - self._prearm_s >= TEXTS_S)
        rates = self._session.rates_hz
        return (
            checked
            and state.version is not None
            and self._clock.delay is not None
            and self._parameters.complete(self._session.dialect, state.parameters, now_s)
            and all(each.optional or enough(each, rates) for each in self._session.dialect.wanted)
        )

    def observation(self, now_s: float) -> Observation:
        """What was observed until host time `now_s`."""
        session, senders = self._session, self._session.senders
        several = senders.ambiguous(session.link_time_s)
        return Observation(
            listened_s=now_s - self._began_s,
            not_found=senders.why_none(session.counters),
            senders=self._senders.found,
            systems=senders.named(session.link_time_s) if several else "",
            vehicle=self.vehicle,
            dialect=session.dialect,
            fix_type=self._fix_type,
            link=self._measures(now_s),
            clock=self._clock_measures(),
        )

    def _measures(self, now_s: float) -> LinkMeasures:
        dialect, counters = self._session.dialect, self._senders.counters
        wanted = dialect.wanted if dialect else ()
        passed_s = max(now_s - (self._found_s or self._began_s), 1e-3)
        trips_s = self._round_trips_s
        return LinkMeasures(
            bytes_received=counters.bytes_received,
            bytes_skipped=counters.bytes_skipped,
            bytes_ps=counters.bytes_received / passed_s,
            wanted_bytes_ps=self._session.wanted_bytes_ps,
            capacity_bytes_ps=self._capacity_bytes_ps,
            messages_bytes_ps={
                name: number / passed_s for name, number in self._senders.message_bytes.items()
            },
            wanted=wanted,
            rates_hz=self._session.rates_hz,
            requested=self._requested,
            delay=self._clock.delay,
            measures_delay=not self._clock.delay_is_measured(now_s),
            round_trip_s=statistics.median(trips_s) if trips_s else None,
            late_s=self._late_s,
            foreign_timesync=int(self._foreign_timesync),
            commands_sent=len(self._asked.keys() - {TIMESYNC}),
            acknowledged=dict(self._acknowledged),
        )

    def _clock_measures(self) -> ClockMeasures:
        rate = None
        if self._first and self._newest and self._newest[1] - self._first[1] > 1.0:
            (began_s, heard_s), (ended_s, ended_at_s) = self._first, self._newest
            rate = (ended_s - began_s - self._clock.jumped_s) / (ended_at_s - heard_s)
        return ClockMeasures(rate, self._clock.jumped_s, self._rebooted)


def enough(wanted: WantedMessage, rates_hz: dict[str, float]) -> bool:
    """Whether a message arrives at nearly the rate that is wanted."""
    return rates_hz.get(wanted.name, 0.0) >= ENOUGH * wanted.arrives_hz
