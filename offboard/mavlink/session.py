"""The session with one autopilot, without I/O: identity, telemetry, and what must be sent to it.

Bytes and `now_s` (monotonic host seconds) are arguments. Events, frames for the log and messages to
send are returned. No socket, no file, no clock. Nothing that arrives can raise.

The first autopilot heard is the vehicle, known by system id, component id and network address. From
then on every other sender is dropped and counted; `Peer` says when the vehicle's address may
change. Our system id is the vehicle's, which makes us one of its components.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass, replace

from offboard.mavlink import framing
from offboard.mavlink.autopilots import AUTOPILOT_COMPONENT, Autopilots, is_companion
from offboard.mavlink.autopilots import DIALECTS as DIALECTS
from offboard.mavlink.counters import FORGED, Counters, DropReason
from offboard.mavlink.decode import (
    Address,
    decode,
    decode_ack_address,
    decode_command,
    decode_custom_mode,
    decode_text_chunk,
    decode_timesync,
)
from offboard.mavlink.dialects.base import TYPE_ONBOARD_CONTROLLER, Dialect
from offboard.mavlink.encode import encode
from offboard.mavlink.events import (
    Attitude,
    ClockBehind,
    CommandRequest,
    Event,
    LocalPosition,
    ModeReport,
    OtherCompanion,
    OtherSender,
    PeerChanged,
    Rebooted,
    TimesyncReply,
    VehicleFound,
)
from offboard.mavlink.events import Heartbeat as HeartbeatEvent
from offboard.mavlink.outgoing import CommandLong, Heartbeat, Outgoing, Record, Timesync
from offboard.mavlink.peer import Peer
from offboard.mavlink.signing import Signing
from offboard.mavlink.telemetry_rates import SHARE, TelemetryRates, fitted
from offboard.mavlink.texts import TextAssembler
from offboard.mavlink.vehicle_time import SILENCE_S, Age, LinkTime, VehicleTime

ACTIVE = 4  # MAV_STATE

_COMMANDS = (75, 76)  # COMMAND_INT, COMMAND_LONG
# MAV_CMD: return, land, take off, set the mode, go to a place, begin a mission, arm or disarm
_MODE_COMMANDS = frozenset({20, 21, 22, 176, 192, 300, 400})
_ECHOES = 256  # newest frames of ours that are recognised when they come back
# A link may reorder: a report of the mode this close behind a newer one says nothing new
_REORDERED_FRAMES, _REORDERED_S = 32, 0.1
_NOT_LOGGED = (DropReason.ECHO, *FORGED)
_HEARTBEAT_PERIOD_S = 0.999  # 1 Hz; below 1 s, so that no rounding error delays it by a cycle


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """How a session behaves.

    `system_id` is the only system that may be the vehicle; None: the first autopilot heard.
    `record_component_id` is the sender of records, which only our log holds; each component id has
    its own sequence numbers. `stream`: serial or TCP, bytes arrive in any portions. `sends_first`:
    send heartbeats before an autopilot was heard. `capacity_bytes_ps` of the link limits the rates
    of telemetry that are requested; None: unknown. `lockstep`: the vehicle waits for our replies,
    and the host times given to `receive` and `poll` are ignored, so that nothing that is sent
    depends on them. Vehicle time replaces them; while telemetry is missing, its TIMESYNC requests
    count on.
    """

    system_id: int | None = None
    component_id: int = 191  # MAV_COMP_ID_ONBOARD_COMPUTER
    record_component_id: int = 191
    stream: bool = False
    sends_first: bool = False
    capacity_bytes_ps: float | None = None
    lockstep: bool = False


@dataclass(frozen=True, slots=True)
class Reception:
    """Result of one portion of bytes.

    `frames` are all with a correct checksum, used or not, except those with our ids and those that
    signing refused; they are for the log, in which our ids mean that we sent a frame. `unlogged`
    are those that another program sent with our ids or those of our records, each after the number
    of `frames` before it.
    `replies` answer TIMESYNC requests. They must be sent last: in lockstep, what is sent after the
    reply is applied one barrier later.
    """

    frames: tuple[bytes, ...] = ()
    events: tuple[Event, ...] = ()
    replies: tuple[Outgoing, ...] = ()
    unlogged: tuple[tuple[int, bytes], ...] = ()


class Session:
    """See the module. `vehicle` and `dialect` are None until an autopilot was heard. With `signing`
    all frames are signed, and those without its signature are dropped."""

    def __init__(self, settings: SessionSettings, signing: Signing | None = None) -> None:
        self.settings = settings
        self.autopilots = Autopilots(settings.system_id)
        self._signing = signing
        self._greeted: Dialect | None = None  # autopilot whose clock is behind ours
        self.counters = Counters()
        self.vehicle: VehicleFound | None = None
        self.dialect: Dialect | None = None
        self.status = (ACTIVE, 0)  # system_status and custom_mode of our heartbeat
        self._own = Address(1, settings.component_id)
        self._peer = Peer()
        self._splitter = framing.FrameSplitter(settings.stream, self.counters)
        self._sequence_out: dict[int, int] = {}
        self._sent: deque[bytes] = deque(maxlen=_ECHOES)
        self._texts = TextAssembler()
        self._time = VehicleTime()
        self._arrival_s = 0.0  # vehicle time when the newest datagram arrived
        self._began_s: float | None = None  # stamp of the first TIMESYNC request
        self._elapsed_s = 0.0  # from it to the newest one: in lockstep, simulated time
        self._telemetry_s = 0.0  # `_elapsed_s` when the newest telemetry arrived
        self._link_time = LinkTime()
        self._rates = TelemetryRates((), 0.0)
        self._capacity_bytes_ps = settings.capacity_bytes_ps
        self._heartbeat_sent: tuple[float, float] | None = None  # host time, link time
        self._status_sent = self.status
        self._mode_report = (0, -math.inf)  # sequence number of the newest, and when it arrived

    # --- in ---

    def receive(self, datagram: bytes, peer: Hashable, now_s: float) -> Reception:
        """Process a datagram, or any portion of a stream, that came from `peer`. Never raises."""
        self._arrival_s = self._time.newest_s
        now_s = self._clock_s(now_s)
        frames: list[bytes] = []
        unlogged: list[tuple[int, bytes]] = []
        events: list[Event] = []
        if self._peer.is_foreign(peer):
            if not self._peer.moves_to(peer, datagram, now_s, self._is_genuine):
                self.counters.dropped[DropReason.FOREIGN_PEER] += 1
                return Reception()
            self._heartbeat_sent = None  # a router learns our address from it
            events.append(PeerChanged(peer))
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
            if outcome in _NOT_LOGGED or frame.message_id == framing.SETUP_SIGNING:
                continue  # the latter holds the key
            if self._has_our_ids(frame):
                unlogged.append((len(frames), frame.raw))
            elif frame.verified:
                frames.append(frame.raw)
        return Reception(tuple(frames), tuple(events), tuple(replies), tuple(unlogged))

    def _accept(
        self,
        frame: framing.Frame,
        peer: Hashable,
        now_s: float,
        events: list[Event],
        replies: list[Outgoing],
    ) -> DropReason | bool:
        """Why the frame was dropped, or whether it was decoded."""
        sender = Address(frame.system_id, frame.component_id)
        ours = sender == self._own
        if ours and frame.raw in self._sent:
            return DropReason.ECHO
        forged = self._signing.accept(frame) if self._signing else None
        if forged:
            self.counters.forged += 1
            if forged is DropReason.OLD_STAMP and self.vehicle is None:
                self._greet(frame, events)
            return forged
        if self.vehicle is not None and (self._is_setpoint(frame) or self._sets_mode(frame)):
            events.append(OtherSender(*sender, frame.message_id))
        if ours:
            if self.vehicle is not None and is_companion(frame, self._own.system_id):
                events.append(OtherCompanion(*sender, decode_custom_mode(frame.payload)))
            return DropReason.SAME_IDS
        if frame.message_id in _COMMANDS and frame.verified and self.vehicle is not None:
            return self._requested(frame, sender, events)
        foreign = self._check_sender(frame, peer, events)
        if foreign is not None:
            if self.vehicle is not None and is_companion(frame, self._own.system_id):
                events.append(OtherCompanion(*sender, decode_custom_mode(frame.payload)))
            return foreign
        if not frame.verified:
            return DropReason.UNKNOWN_ID
        if self.vehicle is not None:
            self._peer.heard_s = now_s
        if frame.message_id == framing.TIMESYNC:
            tc1_ns, ts1_ns = decode_timesync(frame.payload)
            if tc1_ns == 0:
                stamp_s = ts1_ns * 1e-9
                self._began_s = stamp_s if self._began_s is None else self._began_s
                self._elapsed_s = stamp_s - self._began_s
                # a reply at time 0 would look like a request
                replies.append(Timesync(max(1, int(now_s * 1e9)), ts1_ns))
            elif self.vehicle is not None:
                wrapped_ns = round(self._time.wrapped_s(tc1_ns / 1e9) * 1e9)
                events.append(TimesyncReply(ts1_ns, tc1_ns + wrapped_ns))
            return True
        return self._interpret(frame, now_s, events)

    def _has_our_ids(self, frame: framing.Frame) -> bool:
        """Whether it has the ids of what we send, or of our records."""
        ours = (self.settings.component_id, self.settings.record_component_id)
        return frame.system_id == self._own.system_id and frame.component_id in ours

    def _requested(
        self, frame: framing.Frame, sender: Address, events: list[Event]
    ) -> DropReason | bool:
        """A command on the vehicle's own link; one to all components is not for us."""
        command, parameters, receiver = decode_command(frame.message_id, frame.payload)
        if receiver != self._own:
            return DropReason.NOT_FOR_US
        events.append(CommandRequest(command, parameters, *sender))
        return True

    def _is_setpoint(self, frame: framing.Frame) -> bool:
        """Whether it is a setpoint for our vehicle, or for all: routers forward those of others."""
        offset = framing.SETPOINTS.get(frame.message_id)
        if offset is None:
            return False
        target = frame.payload[offset : offset + 1]  # MAVLink 2 omits trailing zeros
        return not target or target[0] in (0, self._own.system_id)

    def _sets_mode(self, frame: framing.Frame) -> bool:
        """Whether it commands the mode of our vehicle, from its own system, as we do: that of a
        ground station is the pilot's."""
        if not frame.verified or frame.system_id != self._own.system_id:
            return False
        if frame.message_id not in _COMMANDS or frame.component_id == AUTOPILOT_COMPONENT:
            return False
        command, _, receiver = decode_command(frame.message_id, frame.payload)
        for_vehicle = receiver.system_id in (0, self._own.system_id) and receiver != self._own
        return command in _MODE_COMMANDS and for_vehicle

    def _check_sender(
        self, frame: framing.Frame, peer: Hashable, events: list[Event]
    ) -> DropReason | None:
        """Why this frame is not from our vehicle; the first heartbeat of an autopilot pins it."""
        heard = self.autopilots.note(frame, self.link_time_s)
        if self.vehicle is not None:
            if frame.system_id != self.vehicle.system_id:
                return DropReason.FOREIGN_SYSTEM
            if frame.component_id != self.vehicle.component_id:
                return DropReason.FOREIGN_COMPONENT
            if isinstance(heard, DropReason):
                return heard  # a HEARTBEAT with its ids that is no autopilot's
            other = heard is not None and heard.name != self.vehicle.autopilot
            return DropReason.FOREIGN_COMPONENT if other else None
        if frame.component_id != AUTOPILOT_COMPONENT:
            return DropReason.FOREIGN_COMPONENT
        if self.settings.system_id not in (None, frame.system_id):
            return DropReason.FOREIGN_SYSTEM
        if frame.message_id == framing.TIMESYNC and frame.verified:
            return None  # a simulator in lockstep may need the reply before its first heartbeat
        if not isinstance(heard, Dialect):
            return heard or DropReason.NO_VEHICLE
        if frame.signed and self._signing is None:
            return DropReason.NO_KEY
        vehicle = VehicleFound(frame.system_id, frame.component_id, heard.name)
        self.adopt(vehicle, peer)
        events.append(vehicle)
        return None

    def _greet(self, frame: framing.Frame, events: list[Event]) -> None:
        """Send our heartbeat to a vehicle whose signature is right and whose clock is behind: its
        time stamp becomes the vehicle's time, as ours would become its. It may be a replay, so that
        nothing else is believed."""
        heard = self.autopilots.note(frame, self.link_time_s)
        wanted = self.settings.system_id in (None, frame.system_id)
        if isinstance(heard, Dialect) and wanted:
            shown = decode(frame.message_id, frame.payload, heard)
            if isinstance(shown, HeartbeatEvent):
                self._greeted = heard
                events.append(ClockBehind(frame.system_id, shown.armed))

    def _is_genuine(self, frame: framing.Frame) -> bool:
        """Whether this frame could be accepted from the vehicle."""
        return frame.verified and (self._signing is None or self._signing.fault(frame) is None)

    def overhear(self, datagram: bytes) -> list[int]:
        """Systems with an autopilot that this datagram, from another address than the vehicle's,
        shows, each once a second."""
        known = dict(self.autopilots.systems)
        for frame in framing.FrameSplitter(False, Counters()).split(datagram):
            if self._is_genuine(frame):
                self.autopilots.note(frame, self.link_time_s)
        return [each for each, _ in self.autopilots.systems.items() - known.items()]

    def adopt(self, vehicle: VehicleFound, peer: Hashable) -> None:
        """Take this vehicle, which sends from `peer`, as ours."""
        self.dialect = DIALECTS[vehicle.autopilot]
        self.vehicle = vehicle
        self._peer.pin(peer, Address(vehicle.system_id, vehicle.component_id))
        self._own = Address(vehicle.system_id, self.settings.component_id)
        self._heartbeat_sent = None  # send it at once, with the vehicle's system id
        self._restart_rates()

    def _interpret(
        self, frame: framing.Frame, now_s: float, events: list[Event]
    ) -> DropReason | bool:
        """Turn a frame of the vehicle into events."""
        assert self.dialect is not None
        if frame.message_id == framing.STATUSTEXT:
            events.extend(self._texts.add(decode_text_chunk(frame.payload), now_s))
            return True
        if frame.message_id == framing.COMMAND_ACK and not self._for_us(frame.payload):
            return DropReason.NOT_FOR_US
        event = decode(frame.message_id, frame.payload, self.dialect)
        if isinstance(event, DropReason):
            return event
        if isinstance(event, (HeartbeatEvent, ModeReport)) and self._overtaken(frame, now_s):
            return DropReason.STALE
        age = Age.FRESH
        if isinstance(event, (LocalPosition, Attitude)):
            wrapped_s = self._time.wrapped_s(event.time_s)
            if wrapped_s:
                event = replace(event, time_s=event.time_s + wrapped_s)
            age = self._time.check(frame.message_id, event.time_s)
            if age is Age.STALE:
                return DropReason.STALE
        # after the check of the stamp: duplicates must not raise the measured rate
        self._rates.count(frame.message_id, self._link_time.seconds)
        if event is None:
            return False
        if isinstance(event, (LocalPosition, Attitude)):
            if age is Age.REBOOTED:
                self._restart_rates()  # a rebooted vehicle has its default rates
                events.append(Rebooted(event.time_s))
            self._link_time.vehicle(event.time_s, now_s)
            self._telemetry_s = self._elapsed_s
        events.append(event)
        return True

    def _overtaken(self, frame: framing.Frame, now_s: float) -> bool:
        """Whether this report of the mode was sent before the newest one."""
        newest, arrived_s = self._mode_report
        behind = (newest - frame.sequence) % 256
        if 0 < behind <= _REORDERED_FRAMES and now_s - arrived_s < _REORDERED_S:
            return True
        self._mode_report = frame.sequence, now_s
        return False

    def _for_us(self, ack_payload: bytes) -> bool:
        to = decode_ack_address(ack_payload)
        return to.system_id in (0, self._own.system_id) and (
            to.component_id in (0, self._own.component_id)
        )

    def _restart_rates(self) -> None:
        assert self.dialect is not None
        wanted = self.dialect.wanted
        if self._capacity_bytes_ps is not None:
            wanted = fitted(wanted, self._capacity_bytes_ps)
        self._rates = TelemetryRates(wanted, self._link_time.seconds)

    def thin_telemetry(self) -> bool:
        """Request half of the telemetry from now on: the link is saturated. False if the rates are
        the lowest already."""
        before = self._rates.bytes_ps
        self._capacity_bytes_ps = 0.5 * before / SHARE
        self._restart_rates()
        return self._rates.bytes_ps < 0.99 * before

    # --- out ---

    def poll(self, now_s: float) -> tuple[Outgoing, ...]:
        """Messages that are due at `now_s`; call it at least every 50 ms.

        They are our heartbeat, at 1 Hz of host or vehicle time, whichever is faster, and where its
        custom_mode has changed, so that another program learns at once who flies; and requests for
        telemetry that is missing or too slow.
        """
        now_s = self._clock_s(now_s)
        self._link_time.host(now_s)
        dialect = self.dialect or self._greeted
        if dialect is None and not self.settings.sends_first:
            return ()
        due: list[Outgoing] = []
        link_s = self._link_time.seconds
        if (
            self._heartbeat_sent is None
            or self.status[1] != self._status_sent[1]
            or max(now_s - self._heartbeat_sent[0], link_s - self._heartbeat_sent[1])
            >= _HEARTBEAT_PERIOD_S
        ):
            self._heartbeat_sent, self._status_sent = (now_s, link_s), self.status
            due.append(Heartbeat(TYPE_ONBOARD_CONTROLLER, *self.status))
        requests = self._rates.due(link_s)
        return (*due, *(CommandLong.message_interval(w.message_id, w.rate_hz) for w in requests))

    def encode(self, outgoing: Outgoing) -> bytes:
        """The frame of a message, with the next sequence number of its component.

        Raises ValueError if a value is not finite or out of range, or if the message is for the
        vehicle and none was found.
        """
        target = None
        if self.vehicle is not None:
            target = Address(self.vehicle.system_id, self.vehicle.component_id)
        packed = encode(outgoing, target, self.dialect)
        component_id = self.settings.component_id
        if isinstance(outgoing, Record):
            component_id = self.settings.record_component_id
        sequence = self._sequence_out.get(component_id, 0)
        self._sequence_out[component_id] = (sequence + 1) % 256
        signing = None if isinstance(outgoing, Record) else self._signing
        frame = framing.pack(
            *packed, sequence, self._own.system_id, component_id, signed=signing is not None
        )
        if signing:
            frame = signing.sign(frame)
        self._sent.append(frame)
        return frame

    def _clock_s(self, host_s: float) -> float:
        if not self.settings.lockstep:
            return host_s
        silent_s = self._elapsed_s - self._telemetry_s
        return self._arrival_s + (silent_s if silent_s > SILENCE_S else 0.0)

    def elapsed_s(self, host_s: float) -> float:
        """Host time; in lockstep the simulated time, which goes on while telemetry is missing."""
        return self._elapsed_s if self.settings.lockstep else host_s

    # --- state of the link ---

    @property
    def link_time_s(self) -> float:
        """Monotonic seconds that follow vehicle time, or host time while telemetry is missing."""
        return self._link_time.seconds

    def clock_s(self, host_s: float) -> float:
        """Host time; in lockstep, where host time must decide nothing, the link's own seconds."""
        return self.link_time_s if self.settings.lockstep else host_s

    @property
    def rates_hz(self) -> dict[str, float]:
        """Measured rate of each wanted message over the last two seconds of `link_time_s`."""
        return self._rates.measured_hz(self._link_time.seconds)

    @property
    def wanted_bytes_ps(self) -> float:
        """Bytes per second of the telemetry that is requested."""
        return self._rates.bytes_ps
