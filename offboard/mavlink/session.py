"""The session with one autopilot, without I/O: identity, telemetry, and what must be sent to it.

Bytes and `now_s` (monotonic host seconds) are arguments. Events, frames for the log and messages to
send are returned. No socket, no file, no clock. Nothing that arrives can raise.

`senders` says whose a frame is. Our system id is the vehicle's, which makes us one of its
components.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field

from pymavlink.dialects.v20 import all as mavlink

from offboard.mavlink import framing
from offboard.mavlink.counters import FORGED, Counters, DropReason
from offboard.mavlink.dialects.base import TYPE_ONBOARD_CONTROLLER, Dialect
from offboard.mavlink.events import Event, PeerChanged, TimesyncReply, VehicleFound
from offboard.mavlink.outgoing import CommandLong, Heartbeat, Outgoing, Record, Target, Timesync
from offboard.mavlink.senders import COMMANDS, Senders
from offboard.mavlink.signing import Signing
from offboard.mavlink.telemetry import Telemetry

ACTIVE = 4  # MAV_STATE
COMPONENT_ID = 191  # MAV_COMP_ID_ONBOARD_COMPUTER: the sender of frames
# MAV_COMP_ID_ONBOARD_COMPUTER2: the sender of records, which only our log holds. Its own sequence
# numbers leave no gap in those of the frames that the vehicle counts.
RECORD_COMPONENT_ID = 192

_NOT_LOGGED = (DropReason.ECHO, *FORGED)
_ECHOES = 256  # newest frames of ours that are recognised when they come back
_HEARTBEAT_PERIOD_S = 0.999  # 1 Hz; below 1 s, so that no rounding error delays it by a cycle


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """How a session behaves.

    `system_id` is the only system that may be the vehicle; None: the first autopilot heard.
    `stream`: serial or TCP, bytes arrive in any portions. `sends_first`: send heartbeats before an
    autopilot was heard. `capacity_bytes_ps` of the link limits the rates of telemetry that are
    requested; None: unknown. `lockstep`: the host times given to `receive` and `poll` are ignored,
    see `VehicleTime`.
    """

    system_id: int | None = None
    component_id: int = COMPONENT_ID
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


@dataclass(slots=True)
class _Arrival:
    """A datagram, or a portion of a stream, and what is found in it."""

    peer: Hashable
    now_s: float
    events: list[Event] = field(default_factory=list)
    replies: list[Outgoing] = field(default_factory=list)


class Session:
    """See the module. `vehicle` and `dialect` are None until an autopilot was heard. With `signing`
    all frames are signed, and those without its signature are dropped. `status` is system_status
    and custom_mode of our heartbeat."""

    def __init__(self, settings: SessionSettings, signing: Signing | None = None) -> None:
        self.settings = settings
        self.senders = Senders(
            settings.system_id, settings.component_id, has_key=signing is not None
        )
        self.counters = Counters()
        self.status = (ACTIVE, 0)
        self._signing = signing
        self._splitter = framing.FrameSplitter(settings.stream, self.counters)
        self._sending = mavlink.MAVLink(None, srcComponent=settings.component_id)
        self._recording = mavlink.MAVLink(None, srcComponent=RECORD_COMPONENT_ID)
        self._components = (settings.component_id, RECORD_COMPONENT_ID)
        self._sent: deque[bytes] = deque(maxlen=_ECHOES)
        self.telemetry = Telemetry(settings.capacity_bytes_ps, lockstep=settings.lockstep)
        self.time = self.telemetry.time
        self._heartbeat_sent: tuple[float, float] | None = None  # host time, link time
        self._status_sent = self.status

    @property
    def vehicle(self) -> VehicleFound | None:
        return self.senders.vehicle

    @property
    def dialect(self) -> Dialect | None:
        return self.senders.dialect

    @property
    def peer(self) -> Hashable | None:
        """Address that the vehicle sends from; None before it is heard."""
        return self.senders.peer

    # --- in ---

    def receive(self, datagram: bytes, peer: Hashable, now_s: float) -> Reception:
        """Process a datagram, or any portion of a stream, that came from `peer`. Never raises."""
        self.time.on_datagram()
        arrival = _Arrival(peer, self.time.now_s(now_s))
        if self.vehicle is not None and peer != self.peer:
            if not self.senders.moves_to(peer, arrival.now_s, self._genuine(datagram)):
                self.counters.dropped[DropReason.FOREIGN_PEER] += 1
                return Reception()
            self._heartbeat_sent = None  # a router learns our address from it
            arrival.events.append(PeerChanged(peer))
        frames: list[bytes] = []
        unlogged: list[tuple[int, bytes]] = []
        arrival.events.extend(self.telemetry.texts.expire(arrival.now_s))
        for frame in self._splitter.split(datagram):
            why = self._accept(frame, arrival)
            self.counters.count(why)
            if (why and why in _NOT_LOGGED) or frame.message_id == framing.SETUP_SIGNING:
                continue  # the latter holds the key
            ours = frame.component_id in self._components
            if ours and frame.system_id == self.senders.own.system_id:
                unlogged.append((len(frames), frame.raw))
            else:
                frames.append(frame.raw)
        return Reception(
            tuple(frames), tuple(arrival.events), tuple(arrival.replies), tuple(unlogged)
        )

    def _accept(self, frame: framing.Frame, arrival: _Arrival) -> DropReason | None:
        """Add to `arrival` what a frame says; why it was dropped."""
        if frame.component_id == self.settings.component_id and frame.raw in self._sent:
            return DropReason.ECHO
        forged = self._signing.refusal(frame) if self._signing else None
        if forged:
            if forged is DropReason.OLD_STAMP and self.vehicle is None:
                self.senders.note_clock_behind(
                    frame, arrival.peer, self.link_time_s, arrival.events
                )
            return forged
        was_found = self.vehicle is not None
        why = self.senders.judge(frame, arrival.peer, self.link_time_s, arrival.events)
        if why or frame.message_id in COMMANDS:
            return why
        if self.vehicle is not None:
            self.senders.heard_s = arrival.now_s
            if not was_found:
                self._begin()
        if frame.message_id == framing.TIMESYNC:
            self._synchronise(frame, arrival)
            return None
        return self.telemetry.interpret(frame, arrival.now_s, arrival.events)

    def _synchronise(self, frame: framing.Frame, arrival: _Arrival) -> None:
        """TIMESYNC: tc1 is 0 in a request."""
        tc1_ns, ts1_ns = frame.message.tc1, frame.message.ts1
        if tc1_ns == 0:
            self.time.on_request(ts1_ns * 1e-9)
            # a reply at time 0 would look like a request
            arrival.replies.append(Timesync(max(1, int(arrival.now_s * 1e9)), ts1_ns))
        elif self.vehicle is not None:
            wrapped_ns = round(self.time.wrapped_s(tc1_ns / 1e9) * 1e9)
            arrival.events.append(TimesyncReply(ts1_ns, tc1_ns + wrapped_ns))

    # --- the vehicle ---

    def set_vehicle(self, vehicle: VehicleFound, peer: Hashable) -> None:
        """Take this vehicle, which sends from `peer`, as ours."""
        self.senders.set_vehicle(vehicle, peer)
        self._begin()

    def _begin(self) -> None:
        assert self.dialect is not None
        self._heartbeat_sent = None  # send it at once, with the vehicle's system id
        self.telemetry.begin(self.dialect)

    def overhear(self, datagram: bytes) -> list[int]:
        """Systems with an autopilot that this datagram, from another address than the vehicle's,
        shows, each once a second."""
        return self.senders.overhear(self._genuine(datagram), self.link_time_s)

    def _genuine(self, datagram: bytes) -> Iterator[framing.Frame]:
        """The frames of a datagram that signing would accept. Counts nothing, uses up no stamp."""
        for frame in framing.FrameSplitter(False, Counters()).split(datagram):
            if not (self._signing and self._signing.refusal(frame, note=False)):
                yield frame

    # --- out ---

    def poll(self, now_s: float) -> tuple[Outgoing, ...]:
        """Messages that are due at `now_s`; call it at least every 50 ms.

        They are our heartbeat, at 1 Hz of host or vehicle time, whichever is faster, and where its
        custom_mode has changed, so that another program learns at once who flies; and requests for
        telemetry that is missing or too slow.
        """
        now_s = self.time.now_s(now_s)
        self.time.on_host(now_s)
        if not (self.dialect or self.senders.clock_behind or self.settings.sends_first):
            return ()
        due: list[Outgoing] = []
        link_s = self.link_time_s
        if (
            self._heartbeat_sent is None
            or self.status[1] != self._status_sent[1]
            or max(now_s - self._heartbeat_sent[0], link_s - self._heartbeat_sent[1])
            >= _HEARTBEAT_PERIOD_S
        ):
            self._heartbeat_sent, self._status_sent = (now_s, link_s), self.status
            due.append(Heartbeat(TYPE_ONBOARD_CONTROLLER, *self.status))
        requests = self.telemetry.due()
        return (*due, *(CommandLong.message_interval(w.message_id, w.rate_hz) for w in requests))

    def encode(self, outgoing: Outgoing) -> bytes:
        """The frame of a message, with the next sequence number of its component.

        Raises ValueError if a value is not finite or out of range, or if the message is for the
        vehicle and none was found.
        """
        vehicle, dialect, target = self.vehicle, self.dialect, None
        if vehicle and dialect:
            target = Target(vehicle.system_id, vehicle.component_id, dialect.divides_by_tilt)
        message = outgoing.encode(target)
        sender = self._sending
        if isinstance(outgoing, Record):
            sender = self._recording
        elif self._signing:
            self._signing.sign(sender)
        sender.srcSystem = self.senders.own.system_id
        frame = bytes(message.pack(sender))
        sender.seq = (sender.seq + 1) % 256
        self._sent.append(frame)
        return frame

    # --- time and rates ---

    def elapsed_s(self, host_s: float) -> float:
        """Host time; in lockstep the simulated time, which goes on while telemetry is missing."""
        return self.time.lockstep_s if self.settings.lockstep else host_s

    def clock_s(self, host_s: float) -> float:
        """Host time; in lockstep, where host time must decide nothing, the link's own seconds."""
        return self.link_time_s if self.settings.lockstep else host_s

    @property
    def link_time_s(self) -> float:
        """Monotonic seconds that follow vehicle time, or host time while telemetry is missing."""
        return self.time.seconds
