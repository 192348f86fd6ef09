"""The session with one autopilot, without I/O: its identity, its telemetry, and messages to it.

Bytes and `now_s` (monotonic host time in seconds) are arguments. Events, frames for the log and
messages to send are returned. No socket, no file, no clock. No received bytes can raise.

`senders` decides who has sent a frame. We use the system id of the vehicle, which makes us one of
its components.
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
# MAV_COMP_ID_ONBOARD_COMPUTER2: the sender of records, which are only in our log. Records have
# their own sequence numbers, so that the vehicle sees no gaps in those of the frames.
RECORD_COMPONENT_ID = 192

_ECHOES = 256  # our newest frames, which are recognised if a router sends them back
REPEATS_MIN = 3  # of one TIMESYNC request: a router may duplicate a datagram
_HEARTBEAT_PERIOD_S = 0.999  # 1 Hz; below 1 s, so that rounding does not delay it by a turn


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """Settings of a session.

    `system_id` is the only system id that the vehicle may have; None: that of the first autopilot
    heard. `stream`: whether received bytes may end within a frame (serial, TCP). `sends_first`:
    whether to send heartbeats before an autopilot is heard. `capacity_bytes_ps`, the capacity of
    the link in bytes per second, limits the requested telemetry rates; None: unknown. `lockstep`:
    whether simulated time replaces host time, see `Session.elapsed_s`.
    """

    system_id: int | None = None
    component_id: int = COMPONENT_ID
    stream: bool = False
    sends_first: bool = False
    capacity_bytes_ps: float | None = None
    lockstep: bool = False


@dataclass(slots=True)
class Reception:
    """Result of receiving one datagram or one portion of a stream.

    `frames` are for the log: all frames with a correct checksum, used or not, except those with our
    ids (which in the log mean that we sent a frame), those that signing refused, and SETUP_SIGNING,
    which contains the key. `unlogged` are
    frames that another program sent with our ids or those of our records, each as a pair: the
    number of `frames` before it, and the frame. `replies` answer the TIMESYNC requests of a
    simulator in lockstep. They must be sent last: a frame that is sent after the reply acts one
    barrier later.
    """

    frames: list[bytes] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    replies: list[Outgoing] = field(default_factory=list)
    unlogged: list[tuple[int, bytes]] = field(default_factory=list)


class Session:
    """See the module. `vehicle` and `dialect` are None until the vehicle was found. With `signing`
    all frames that are sent are signed, and received frames without its signature are dropped."""

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
        self._answers = settings.lockstep  # whether TIMESYNC requests are answered
        self._requested_ns, self._repeats = -1, 0  # newest request, and how often it was repeated
        self._began_s: float | None = None  # stamp of the first TIMESYNC request
        self._simulated_s = 0.0  # from that request to the newest one
        # `elapsed_s`, `link_time_s` and custom_mode of our newest heartbeat
        self._heartbeat_sent: tuple[float, float, int] | None = None

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
            self._heartbeat_sent = None  # send one at once: a router learns our address from it
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
            return  # it contains the key
        ours = frame.component_id in (self.settings.component_id, RECORD_COMPONENT_ID)
        if ours and frame.system_id == self.senders.own.system_id:
            found.unlogged.append((len(found.frames), frame.raw))
        else:
            found.frames.append(frame.raw)

    def _interpret(self, frame: framing.Frame, now_s: float, found: Reception) -> None:
        """Add to `found` the event of a frame of the vehicle, or the reply to its TIMESYNC request
        (which may arrive before the vehicle is found)."""
        if self.dialect is not None:
            self.senders.newest_frame_s = now_s
            if self.telemetry.dialect is None:
                self._heartbeat_sent = None  # send one at once, with the vehicle's system id
                self.telemetry.begin(self.dialect)
        if frame.message_id == framing.TIMESYNC:
            self._synchronise(frame, now_s, found)
        else:
            self.telemetry.interpret(frame, now_s, found.events)

    def _synchronise(self, frame: framing.Frame, now_s: float, found: Reception) -> None:
        """Add to `found` the reply to a TIMESYNC request (tc1 is 0), or the event of a reply.

        Only a simulator in lockstep gets a reply. It repeats its request while it waits. PX4 takes
        the replies of all programs on a link for one clock, by which it reads the time stamps of
        external vision: with a second clock it loses its position.
        """
        tc1_ns, ts1_ns = frame.message.tc1, frame.message.ts1
        if tc1_ns == 0:
            self._repeats = self._repeats + 1 if ts1_ns == self._requested_ns else 0
            self._requested_ns = ts1_ns
            self._answers |= self._repeats >= REPEATS_MIN
            if not self._answers:
                return
            self._began_s = ts1_ns * 1e-9 if self._began_s is None else self._began_s
            self._simulated_s = ts1_ns * 1e-9 - self._began_s
            # not 0, because a reply with tc1 = 0 would be a request
            found.replies.append(Timesync(max(1, int(now_s * 1e9)), ts1_ns))
        elif self.vehicle is not None:
            wrapped_ns = round(self.time.wrapped_s(tc1_ns / 1e9) * 1e9)
            found.events.append(TimesyncReply(ts1_ns, tc1_ns + wrapped_ns))

    # --- out ---

    def poll(self, now_s: float, status: tuple[int, int] = (ACTIVE, 0)) -> tuple[Outgoing, ...]:
        """Messages that are due at `now_s`. Call it at least every 50 ms.

        They are our HEARTBEAT and requests for telemetry that is missing or too slow. `status` is
        system_status and custom_mode of the HEARTBEAT. It is due at 1 Hz of host or vehicle time,
        whichever is faster, and at once if custom_mode has changed, so that another program learns
        who flies.
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
        """Pack a message as a frame with the next sequence number of its component, and sign it.

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
        """Host time `host_s` in seconds. In lockstep, where nothing may depend on host time: the
        simulated time since the simulator's first TIMESYNC request."""
        return self._simulated_s if self.settings.lockstep else host_s

    @property
    def link_time_s(self) -> float:
        """Link time: monotonic seconds that follow vehicle time, or host time while telemetry is
        missing."""
        return self.time.seconds
