"""One conversation with one autopilot: who it is, what it said, what we send. Sans-I/O.

Bytes and `now_s` (monotonic host seconds) come in as arguments; events, frames for the log and
frames to send go out as values. No socket, no file, no clock. Nothing that arrives can raise.

The session pins itself to the first autopilot it hears, by system, component and peer, and from
then on drops and counts everybody else. Only where that peer has fallen silent may another port of
the same host go on as the vehicle (`Peer`). Our system id is the vehicle's, so that it takes us
for a part of itself.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from offboard.mavlink import decode as inbound
from offboard.mavlink import encode as outbound
from offboard.mavlink import framing
from offboard.mavlink.counters import Counters, DropReason, SequenceTracker
from offboard.mavlink.decode import Address
from offboard.mavlink.dialects.ardupilot import ARDUPILOT
from offboard.mavlink.dialects.base import TYPE_GCS, TYPE_ONBOARD_CONTROLLER, Dialect, WantedMessage
from offboard.mavlink.dialects.px4 import PX4
from offboard.mavlink.events import (
    Attitude,
    Event,
    LocalPosition,
    Moved,
    Reset,
    TimeAnswer,
    VehicleFound,
)
from offboard.mavlink.outgoing import (
    CommandLong,
    Heartbeat,
    Outgoing,
    Record,
    Timesync,
)
from offboard.mavlink.peer import Peer
from offboard.mavlink.telemetry_rates import LinkTime, Shortfall, TelemetryRates
from offboard.mavlink.texts import TextAssembler
from offboard.mavlink.vehicle_time import Age, VehicleTime

DIALECTS: Mapping[str, Dialect] = MappingProxyType({d.name: d for d in (PX4, ARDUPILOT)})

_HEARTBEAT, _COMMAND_ACK, _TIMESYNC, _STATUSTEXT = 0, 77, 111, 253
_AUTOPILOT_COMPONENT = 1
_NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID
_HEARTBEAT_PERIOD_S = 0.999  # 1 Hz, and no cycle late for a rounding error


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """`system_id` None takes the first autopilot heard. `stream`: serial or TCP, where bytes come
    in any portions. `speaks_first`: heartbeat before anybody was heard (somebody listens at the
    other end). `requests_intervals` False leaves the vehicle's rates alone. `wanted` replaces the
    dialect's telemetry, `wanted_too` adds to it. `record_component_id` stamps the records that only
    our log sees; each component id has its own sequence numbers. `lockstep`: the vehicle waits for
    our answers, and only its time counts: the host times given to `receive` and `poll` are ignored.
    """

    system_id: int | None = None
    component_id: int = 191  # MAV_COMP_ID_ONBOARD_COMPUTER
    stream: bool = False
    speaks_first: bool = False
    requests_intervals: bool = True
    wanted: tuple[WantedMessage, ...] | None = None
    wanted_too: tuple[WantedMessage, ...] = ()
    record_component_id: int = 191
    lockstep: bool = False


@dataclass(frozen=True, slots=True)
class Reception:
    """What one portion of bytes brought, to be handled in this order: log `frames` (all with a
    correct checksum, whatever became of their content, except our own echoes), process `events`,
    then encode and send `replies` (sequence numbers are given in the order of sending)."""

    frames: tuple[bytes, ...] = ()
    events: tuple[Event, ...] = ()
    replies: tuple[Outgoing, ...] = ()


_NOTHING = Reception()


class Session:
    """See the module. `vehicle` and `dialect` are None until an autopilot was heard."""

    def __init__(self, settings: SessionSettings) -> None:
        self.settings = settings
        self.counters = Counters()
        self.vehicle: VehicleFound | None = None
        self.dialect: Dialect | None = None
        self._own = Address(settings.system_id or 1, settings.component_id)
        self._peer = Peer()
        self._splitter = framing.FrameSplitter(settings.stream, self.counters)
        self._sequence_in = SequenceTracker()
        self._sequence_out: dict[int, int] = {}
        self._texts = TextAssembler()
        self._time = VehicleTime()
        self._vehicle_s = 0.0  # newest stamp before the newest datagram
        self._link_time = LinkTime()
        self._rates = TelemetryRates((), 0.0)
        self._heartbeat_sent: tuple[float, float] | None = None  # host time, link time

    # --- in ---

    def receive(self, datagram: bytes, peer: Hashable, now_s: float) -> Reception:
        """Take a datagram (or any portion of a stream) that came from `peer`. Never raises."""
        self._vehicle_s = self._time.newest_s
        now_s = self._clock_s(now_s)
        frames: list[bytes] = []
        events: list[Event] = []
        if self._peer.is_foreign(peer):
            if not self._peer.moves_to(peer, datagram, now_s):
                self.counters.dropped[DropReason.FOREIGN_PEER] += 1
                return _NOTHING
            self._heartbeat_sent = None  # a router learns from it where we are
            events.append(Moved(peer))
        replies: list[Outgoing] = []
        events.extend(self._texts.expire(now_s))
        for frame in self._splitter.split(datagram):
            self.counters.frames += 1
            outcome = self._accept(frame, peer, now_s, events, replies)
            if isinstance(outcome, DropReason):
                self.counters.dropped[outcome] += 1
            elif outcome:
                self.counters.decoded += 1
            else:
                self.counters.ignored += 1
            if frame.verified and outcome is not DropReason.ECHO:
                frames.append(frame.raw)
        return Reception(tuple(frames), tuple(events), tuple(replies))

    def _accept(
        self,
        frame: framing.Frame,
        peer: Hashable,
        now_s: float,
        events: list[Event],
        replies: list[Outgoing],
    ) -> DropReason | bool:
        """Why the frame was dropped, or whether anybody wanted it."""
        if (frame.system_id, frame.component_id) == self._own:
            return DropReason.ECHO
        stranger = self._stranger(frame, peer, events)
        if stranger is not None:
            return stranger
        if self.vehicle is not None:
            self._peer.heard_s = now_s
            self._sequence_in.note(frame.sequence, self.counters)
        if not frame.verified:
            return DropReason.UNKNOWN_ID
        if frame.message_id == _TIMESYNC:
            tc1_ns, ts1_ns = inbound.decode_timesync(frame.payload)
            if tc1_ns == 0:
                # at time 0 the answer would be taken for a question
                replies.append(Timesync(max(1, int(now_s * 1e9)), ts1_ns))
            elif self.vehicle is not None:
                events.append(TimeAnswer(ts1_ns, tc1_ns))
            return True
        return self._interpret(frame, now_s, events)

    def _stranger(
        self, frame: framing.Frame, peer: Hashable, events: list[Event]
    ) -> DropReason | None:
        """Why this frame is not from our vehicle; the first heartbeat of an autopilot pins it."""
        if self.vehicle is not None:
            if frame.system_id != self.vehicle.system_id:
                return DropReason.FOREIGN_SYSTEM
            if frame.component_id != self.vehicle.component_id:
                return DropReason.FOREIGN_COMPONENT
            return None
        if self.settings.system_id not in (None, frame.system_id):
            return DropReason.FOREIGN_SYSTEM
        if frame.component_id != _AUTOPILOT_COMPONENT:
            return DropReason.FOREIGN_COMPONENT
        if frame.message_id == _TIMESYNC and frame.verified:
            return None  # a simulator in lockstep may wait for the answer before its heartbeat
        if frame.message_id != _HEARTBEAT or not frame.verified:
            return DropReason.NO_VEHICLE
        return self._pin(frame, peer, events)

    def _pin(self, frame: framing.Frame, peer: Hashable, events: list[Event]) -> DropReason | None:
        identity = inbound.decode_identity(frame.payload)
        if identity.vehicle_type == TYPE_GCS or identity.autopilot == _NO_AUTOPILOT:
            return DropReason.NO_VEHICLE
        dialect = next(
            (d for d in DIALECTS.values() if d.mav_autopilot == identity.autopilot), None
        )
        if dialect is None:
            return DropReason.UNSUPPORTED_AUTOPILOT
        self.dialect = dialect
        self.vehicle = VehicleFound(frame.system_id, frame.component_id, dialect.name)
        self._peer.pin(peer, Address(frame.system_id, frame.component_id))
        self._own = Address(frame.system_id, self.settings.component_id)
        self._heartbeat_sent = None  # the dialect may want another type: say it at once
        self._watch_rates()
        events.append(self.vehicle)
        return None

    def _interpret(
        self, frame: framing.Frame, now_s: float, events: list[Event]
    ) -> DropReason | bool:
        """Turn a frame of the vehicle into events."""
        assert self.dialect is not None
        if frame.message_id == _STATUSTEXT:
            events.extend(self._texts.add(inbound.decode_text_chunk(frame.payload), now_s))
            return True
        if frame.message_id == _COMMAND_ACK and not self._for_us(frame.payload):
            return DropReason.NOT_FOR_US
        event = inbound.decode(frame.message_id, frame.payload, self.dialect)
        if isinstance(event, DropReason):
            return event
        age = Age.FRESH
        if isinstance(event, (LocalPosition, Attitude)):
            age = self._time.judge(frame.message_id, event.time_s)
            if age is Age.STALE:
                return DropReason.STALE
        # only now: a stream that repeats itself must not look fast enough to fly on
        self._rates.count(frame.message_id, self._link_time.seconds)
        if event is None:
            return False
        if isinstance(event, (LocalPosition, Attitude)):
            if age is Age.REBOOTED:
                self._begin_anew()
                events.append(Reset(event.time_s))
            self._link_time.vehicle(event.time_s, now_s)
        events.append(event)
        return True

    def _for_us(self, ack_payload: bytes) -> bool:
        to = inbound.decode_ack_address(ack_payload)
        return to.system_id in (0, self._own.system_id) and (
            to.component_id in (0, self._own.component_id)
        )

    def _begin_anew(self) -> None:
        """A rebooted vehicle has forgotten the rates we asked for and counts from zero."""
        self._sequence_in = SequenceTracker()
        self._watch_rates()

    def _watch_rates(self) -> None:
        assert self.dialect is not None
        wanted = self.dialect.wanted if self.settings.wanted is None else self.settings.wanted
        self._rates = TelemetryRates((*wanted, *self.settings.wanted_too), self._link_time.seconds)

    # --- out ---

    def poll(self, now_s: float) -> tuple[bytes, ...]:
        """Frames that are due: our heartbeat (1 Hz of host or vehicle time, whichever is faster)
        and requests for telemetry that is missing or too slow. Call it every cycle."""
        now_s = self._clock_s(now_s)
        self._link_time.host(now_s)
        if self.dialect is None and not self.settings.speaks_first:
            return ()  # PX4 remembers the type of every heartbeat and misses the one that changed
        due: list[Outgoing] = []
        link_s = self._link_time.seconds
        if self._heartbeat_sent is None or (
            max(now_s - self._heartbeat_sent[0], link_s - self._heartbeat_sent[1])
            >= _HEARTBEAT_PERIOD_S
        ):
            self._heartbeat_sent = (now_s, link_s)
            kind = TYPE_ONBOARD_CONTROLLER if self.dialect is None else self.dialect.heartbeat_type
            due.append(Heartbeat(kind))
        if self.settings.requests_intervals:
            due.extend(
                CommandLong.message_interval(w.message_id, w.rate_hz)
                for w in self._rates.due(link_s)
            )
        return tuple(self.encode(value) for value in due)

    def encode(self, outgoing: Outgoing) -> bytes:
        """The frame, with the next sequence number. ValueError: not finite, out of range, or
        addressed to the vehicle before one was found."""
        target = None
        if self.vehicle is not None:
            target = Address(self.vehicle.system_id, self.vehicle.component_id)
        packed = outbound.encode(outgoing, target, self.dialect)
        component_id = self.settings.component_id
        if isinstance(outgoing, Record):
            component_id = self.settings.record_component_id
        sequence = self._sequence_out.get(component_id, 0)
        self._sequence_out[component_id] = (sequence + 1) % 256
        return framing.pack(*packed, sequence, self._own.system_id, component_id)

    def _clock_s(self, host_s: float) -> float:
        return self._vehicle_s if self.settings.lockstep else host_s

    # --- what is known of the link ---

    @property
    def link_time_s(self) -> float:
        """Seconds that follow the vehicle's time while it flows, else the host's."""
        return self._link_time.seconds

    @property
    def rates_hz(self) -> dict[str, float]:
        """Measured rate of each wanted message over the last two seconds of vehicle time."""
        return self._rates.measured_hz(self._link_time.seconds)

    @property
    def shortfalls(self) -> list[Shortfall]:
        """Wanted messages that come too slowly to engage."""
        return self._rates.shortfalls(self._link_time.seconds)
