"""The session with one autopilot, without I/O: identity, telemetry, and what must be sent to it.

Bytes and `now_s` (monotonic host seconds) are arguments. Events, frames for the log and messages to
send are returned. No socket, no file, no clock. Nothing that arrives can raise.

`senders` says whose a frame is. Our system id is the vehicle's, which makes us one of its
components.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass, field

from pymavlink.dialects.v20 import all as mavlink

from offboard.mavlink import framing
from offboard.mavlink.dialects.base import TYPE_ONBOARD_CONTROLLER, Dialect
from offboard.mavlink.events import Event, PeerChanged, TimesyncReply, VehicleFound
from offboard.mavlink.outgoing import CommandLong, Heartbeat, Outgoing, Record, Timesync
from offboard.mavlink.senders import Senders
from offboard.mavlink.signing import Signing
from offboard.mavlink.telemetry import Telemetry

ACTIVE = 4  # MAV_STATE
COMPONENT_ID = 191  # MAV_COMP_ID_ONBOARD_COMPUTER: the sender of frames
# MAV_COMP_ID_ONBOARD_COMPUTER2: the sender of records, which only our log holds. Its own sequence
# numbers leave no gap in those of the frames that the vehicle counts.
RECORD_COMPONENT_ID = 192

_ECHOES = 256  # newest frames of ours that are recognised when they come back
_HEARTBEAT_PERIOD_S = 0.999  # 1 Hz; below 1 s, so that no rounding error delays it by a cycle


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """How a session behaves.

    `system_id` is the only system that may be the vehicle; None: the first autopilot heard.
    `stream`: serial or TCP, bytes arrive in any portions. `sends_first`: send heartbeats before an
    autopilot was heard. `capacity_bytes_ps` of the link limits the rates of telemetry that are
    requested; None: unknown. `lockstep`: simulated time takes the place of host time, see
    `Session.elapsed_s`.
    """

    system_id: int | None = None
    component_id: int = COMPONENT_ID
    stream: bool = False
    sends_first: bool = False
    capacity_bytes_ps: float | None = None
    lockstep: bool = False


@dataclass(slots=True)
class Reception:
    """Result of one portion of bytes.

    `frames` are all with a correct checksum, used or not, except those with our ids and those that
    signing refused; they are for the log, in which our ids mean that we sent a frame. `unlogged`
    are those that another program sent with our ids or those of our records, each after the number
    of `frames` before it.
    `replies` answer TIMESYNC requests. They must be sent last: in lockstep, what is sent after the
    reply is applied one barrier later.
    """

    frames: list[bytes] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    replies: list[Outgoing] = field(default_factory=list)
    unlogged: list[tuple[int, bytes]] = field(default_factory=list)


class Session:
    """See the module. `vehicle` and `dialect` are None until an autopilot was heard. With `signing`
    all frames are signed, and those without its signature are dropped."""

    def __init__(self, settings: SessionSettings, signing: Signing | None = None) -> None:
        self.settings = settings
        self.senders = Senders(settings.system_id, settings.component_id, signing)
        self.splitter = framing.FrameSplitter(settings.stream)
        self._signing = signing
        self._sending = mavlink.MAVLink(None, srcComponent=settings.component_id)
        self._recording = mavlink.MAVLink(None, srcComponent=RECORD_COMPONENT_ID)
        self._sent: deque[bytes] = deque(maxlen=_ECHOES)
        self.telemetry = Telemetry(settings.capacity_bytes_ps)
        self.time = self.telemetry.time
        self._began_s: float | None = None  # stamp of the first TIMESYNC request
        self._simulated_s = 0.0  # from it to the newest
        self._heartbeat_sent: tuple[float, float, int] | None = None  # host, link time, custom_mode

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
        now_s = self.elapsed_s(now_s)
        found = Reception()
        if self.vehicle is not None and peer != self.peer:
            if not self.senders.moves_to(peer, now_s, datagram):
                return found
            self._heartbeat_sent = None  # a router learns our address from it
            found.events.append(PeerChanged(peer))
        found.events += self.telemetry.texts.expire(now_s)
        for frame in self.splitter.split(datagram):
            echo = frame.component_id == self.settings.component_id and frame.raw in self._sent
            if echo or self.senders.refuse(frame, peer, self.link_time_s, found.events):
                continue
            self._log(frame, found)
            if self.senders.judge(frame, peer, self.link_time_s, found.events):
                self._interpret(frame, now_s, found)
        return found

    def _log(self, frame: framing.Frame, found: Reception) -> None:
        if frame.message_id == framing.SETUP_SIGNING:
            return  # it holds the key
        ours = frame.component_id in (self.settings.component_id, RECORD_COMPONENT_ID)
        if ours and frame.system_id == self.senders.own.system_id:
            found.unlogged.append((len(found.frames), frame.raw))
        else:
            found.frames.append(frame.raw)

    def _interpret(self, frame: framing.Frame, now_s: float, found: Reception) -> None:
        """Add to `found` the event in a frame of the vehicle, or the reply to its TIMESYNC request
        (which may come before the vehicle is found)."""
        if self.dialect is not None:
            self.senders.heard_s = now_s
            if self.telemetry.dialect is None:
                self._heartbeat_sent = None  # send it at once, with the vehicle's system id
                self.telemetry.begin(self.dialect)
        if frame.message_id == framing.TIMESYNC:
            self._synchronise(frame, now_s, found)
        else:
            self.telemetry.interpret(frame, now_s, found.events)

    def _synchronise(self, frame: framing.Frame, now_s: float, found: Reception) -> None:
        """TIMESYNC: tc1 is 0 in a request."""
        tc1_ns, ts1_ns = frame.message.tc1, frame.message.ts1
        if tc1_ns == 0:
            self._began_s = ts1_ns * 1e-9 if self._began_s is None else self._began_s
            self._simulated_s = ts1_ns * 1e-9 - self._began_s
            # a reply at time 0 would look like a request
            found.replies.append(Timesync(max(1, int(now_s * 1e9)), ts1_ns))
        elif self.vehicle is not None:
            wrapped_ns = round(self.time.wrapped_s(tc1_ns / 1e9) * 1e9)
            found.events.append(TimesyncReply(ts1_ns, tc1_ns + wrapped_ns))

    # --- out ---

    def poll(self, now_s: float, status: tuple[int, int] = (ACTIVE, 0)) -> tuple[Outgoing, ...]:
        """Messages that are due at `now_s`; call it at least every 50 ms.

        They are our heartbeat with `status`, system_status and custom_mode, at 1 Hz of host or
        vehicle time, whichever is faster, and where custom_mode has changed, so that another
        program learns at once who flies; and requests for telemetry that is missing or too slow.
        """
        now_s = self.elapsed_s(now_s)
        self.time.on_host(now_s)
        if not (self.dialect or self.senders.clock_behind or self.settings.sends_first):
            return ()
        due: list[Outgoing] = []
        link_s = self.link_time_s
        sent = self._heartbeat_sent
        passed_s = max(now_s - sent[0], link_s - sent[1]) if sent else math.inf
        if passed_s >= _HEARTBEAT_PERIOD_S or (sent and sent[2] != status[1]):
            self._heartbeat_sent = now_s, link_s, status[1]
            due.append(Heartbeat(TYPE_ONBOARD_CONTROLLER, *status))
        requests = self.telemetry.due()
        return (*due, *(CommandLong.message_interval(w.message_id, w.rate_hz) for w in requests))

    def encode(self, outgoing: Outgoing) -> bytes:
        """The frame of a message, with the next sequence number of its component.

        Raises ValueError if a value is not finite or out of range, or if the message is for the
        vehicle and none was found.
        """
        message = outgoing.encode(self.senders.target)
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
        """Host time; in lockstep, where nothing may depend on host time, the simulated time since
        the simulator's first TIMESYNC request."""
        return self._simulated_s if self.settings.lockstep else host_s

    @property
    def link_time_s(self) -> float:
        """Monotonic seconds that follow vehicle time, or host time while telemetry is missing."""
        return self.time.seconds
