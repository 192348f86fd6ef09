"""The listening pass: collects what is sent on the link, and requests what is missing, until enough
is known.

Sans-I/O: received chunks and host times in, frames out. README.md lists what may be sent.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20.all import mavlink_map

from offboard.flight.preflight import Ground, ParameterReading
from offboard.flight.timing import VehicleClock
from offboard.link.interface import Chunk, peer_name
from offboard.mavlink.decode import FIX_3D
from offboard.mavlink.dialects.base import TYPE_GCS, WantedMessage, id_of
from offboard.mavlink.events import (
    Attitude,
    ClockBehind,
    EstimatorReport,
    Event,
    GpsFix,
    LocalPosition,
    NoFix,
    Rebooted,
    TimesyncReply,
    VehicleFound,
)
from offboard.mavlink.framing import HEARTBEAT, TIMESYNC, Frame, FrameSplitter
from offboard.mavlink.outgoing import CommandLong, Outgoing, Timesync
from offboard.mavlink.senders import is_vehicle
from offboard.mavlink.session import Session, SessionSettings
from offboard.mavlink.signing import Signing
from offboard.mavlink.telemetry import ENOUGH
from offboard.run.configuration import FlightConfig

DOCTOR_ID = 193  # MAV_COMP_ID_ONBOARD_COMPUTER3
NOTHING_S = 6.0  # length of the pass if no autopilot is heard
LEAST_S = 4.0  # least length after the autopilot is first heard
LONGEST_S = 9.0  # greatest length of the pass
ASK_EVERY_S = 1.0  # between two equal requests
TIMESYNC_EVERY_S = 0.1
PREARM_AFTER_S = 1.0  # after the vehicle is found: earlier requests may be lost on a new link
TEXTS_S = 1.0  # to wait for STATUSTEXT after RUN_PREARM_CHECKS is acknowledged
SETTLE_S = 1.0  # after the vehicle is found, before age of telemetry and clock jumps are judged
RUN_PREARM_CHECKS = 401  # MAV_CMD
VERSION, GPS = 148, 24  # message ids
_TIMES = frozenset({2, TIMESYNC})  # 2: SYSTEM_TIME
_PEERS_MAX, _SENDERS_MAX = 16, 64  # limits of memory if addresses or ids flood the link


@dataclass(slots=True)
class Sender:
    """One MAVLink sender. `heartbeat` is its newest HEARTBEAT, or None; `peers` are the addresses
    that it sends from, as text. `shared`: whether an autopilot and another program have its ids."""

    system_id: int
    component_id: int
    heartbeat: Any = None  # message of pymavlink
    peers: set[str] = field(default_factory=set)
    frames: int = 0
    times: int = 0  # number of TIMESYNC and SYSTEM_TIME messages
    shared: bool = False

    @property
    def ids(self) -> tuple[int, int]:
        return self.system_id, self.component_id

    @property
    def is_autopilot(self) -> bool:
        return self.heartbeat is not None and is_vehicle(self.heartbeat)

    @property
    def name(self) -> str:
        is_gcs = self.heartbeat is not None and self.heartbeat.type == TYPE_GCS
        kind = "autopilot" if self.is_autopilot else "ground station" if is_gcs else "component"
        return f"{kind} {self.system_id}/{self.component_id}"


class Senders:
    """Counts the frames of all senders, also those that the session drops. `stream`: whether a
    frame may be split between two portions of received bytes."""

    def __init__(self, stream: bool) -> None:
        self.splitter = FrameSplitter(stream)
        self._senders: dict[tuple[int, int], Sender] = {}
        self._sequences: dict[tuple[int, ...], int] = {}
        # by (system, component), and by (system,)
        self._lost: Counter[tuple[int, ...]] = Counter()
        self.message_bytes: Counter[str] = Counter()

    def receive(self, data: bytes, peer: Hashable) -> None:
        """Count the frames in `data`, which came from `peer`."""
        for frame in self.splitter.split(data):
            self._count(frame, peer)

    def _count(self, frame: Frame, peer: Hashable) -> None:
        ids = frame.system_id, frame.component_id
        if ids not in self._senders and len(self._senders) >= _SENDERS_MAX:
            return
        sender = self._senders.setdefault(ids, Sender(*ids))
        message = mavlink_map.get(frame.message_id)
        self.message_bytes[message.msgname if message else str(frame.message_id)] += len(frame.raw)
        sender.frames += 1
        if len(sender.peers) < _PEERS_MAX:
            sender.peers.add(peer_name(peer))
        sender.times += frame.message_id in _TIMES
        if frame.message_id == HEARTBEAT:
            before, sender.heartbeat = sender.heartbeat, frame.message
            sender.shared |= before is not None and is_vehicle(before) != sender.is_autopilot
        for key in (ids, ids[:1]):
            gap = (frame.sequence - self._sequences.get(key, frame.sequence - 1) - 1) % 256
            self._lost[key] += gap if gap < 128 else 0  # a larger gap is a frame out of order
            self._sequences[key] = frame.sequence

    def lost(self, sender: Sender) -> int:
        """Number of lost frames of a sender: the gaps in its sequence numbers, without the frames
        whose id pymavlink does not know (PX4: EVENT). Components of one system may count their
        frames together: the smaller of both results is taken."""
        unknown = self.splitter.unknown
        of_system = sum(count for ids, count in unknown.items() if ids[0] == sender.system_id)
        own, all_own = self._lost[sender.ids], self._lost[sender.ids[:1]]
        return max(0, min(own - unknown[sender.ids], all_own - of_system))

    @property
    def found(self) -> list[Sender]:
        """All senders, the one with most frames first."""
        return sorted(self._senders.values(), key=lambda sender: -sender.frames)


class Observation(Ground):
    """What the checks judge: the planned flight (`config`, recorded in `directory`) and what is
    heard on the link `connection` from host time `now_s` to `host_s`.

    `settings` are those of the session of that flight. As a `Ground` it has all that the preflight
    list judges. `began_s` is the host time at which the command began; `link_error` says why the
    link cannot be opened; `holders` are other processes that use its port; `senders` has every
    sender. `fix_type` is the vehicle's GPS_FIX_TYPE, at most FIX_3D; `late_s` the greatest age of
    its telemetry beyond the least; `foreign_replies` the number of its replies to TIMESYNC requests
    of other programs.
    """

    def __init__(
        self,
        config: FlightConfig,
        connection: str,
        directory: Path,
        now_s: float,
        settings: SessionSettings,
        signing: Signing | None = None,
    ) -> None:
        super().__init__(
            limits=config.limits,
            session=Session(replace(settings, component_id=DOCTOR_ID), signing),
            model=config.vehicle,
            host_s=now_s,
            rates_requested=False,
            reading=ParameterReading(advice=True),
        )
        self.config, self.connection, self.directory = config, connection, directory
        self.began_s = self._listens_s = now_s
        self.link_error = ""
        self.holders: tuple[str, ...] = ()
        self.senders = Senders(settings.stream)
        self.rebooted = False  # whether the vehicle rebooted during this pass
        self.fix_type: int | None = None
        self.late_s = 0.0
        self.foreign_replies = 0
        self._found_s = 0.0
        self._asked_s: dict[int, float] = {}  # message or command id: host time of the last request
        self._settled = False
        self._may_greet = False  # whether a disarmed vehicle was heard whose signing time is behind
        self._timesync_s = 0.0

    # --- in ---

    def take(self, chunk: Chunk) -> None:
        """Process received bytes."""
        self.senders.receive(chunk.data, chunk.peer)
        if self.session.peer not in (None, chunk.peer):  # it may be from another vehicle
            self.session.senders.overhear(chunk.data, self.session.link_time_s)
        reception = self.session.receive(chunk.data, chunk.peer, chunk.arrived_s)
        for event in reception.events:
            if not self._found_s and self.session.vehicle is not None:
                self._found_s = chunk.arrived_s
            self.vehicle.update(event, self.session.link_time_s)
            self._note(event, chunk.arrived_s)

    def _note(self, event: Event, at_s: float) -> None:
        match event:
            case Attitude(time_s) | LocalPosition(time_s):
                self._on_stamp(time_s, at_s)
            case TimesyncReply():
                self.foreign_replies += not self.clock.on_reply(event)
            case NoFix(fix_type):
                self.fix_type = fix_type
            case GpsFix():
                self.fix_type = FIX_3D
            case ClockBehind(armed=armed):
                self._may_greet = not armed
            case Rebooted():
                self.rebooted = True
                self.clock = VehicleClock()

    def _on_stamp(self, stamp_s: float, at_s: float) -> None:
        self.late_s = max(self.late_s, self.clock.age_s(stamp_s, at_s) if self._settled else 0.0)
        self.clock.on_telemetry(stamp_s, at_s)
        if not self._settled and at_s - self._found_s > SETTLE_S:
            self._settled = True
            self.clock.settle()

    # --- out ---

    def due(self, now_s: float) -> list[bytes]:
        """The frames to send at host time `now_s`. Call it at least every 50 ms."""
        self.host_s = now_s
        return [self.session.encode(each) for each in self._questions(now_s)]

    def _questions(self, now_s: float) -> Iterable[Outgoing]:
        yield from filter(self._permitted, self.session.poll(now_s))
        self.vehicle.now_s = self.session.link_time_s  # ages must grow also while nothing is heard
        dialect, state = self.session.dialect, self.vehicle
        if dialect is None:
            greets = self.session.settings.sends_first or self._may_greet
            if greets and self._may_ask(TIMESYNC, now_s):
                yield Timesync(0, round(now_s * 1e9))
            return
        yield from self.reading.due(dialect, state)
        fix_age_s = min(state.age_s(NoFix), state.age_s(GpsFix))
        unknown = {
            VERSION: state.version is None,
            GPS: fix_age_s > ASK_EVERY_S,
            id_of(dialect.estimator_message): state.age_s(EstimatorReport) > ASK_EVERY_S,
        }
        for message_id, missing in unknown.items():
            if missing and self._may_ask(message_id, now_s):
                yield CommandLong.message(message_id)
        disarmed = state.heartbeat is not None and not state.armed
        unasked = RUN_PREARM_CHECKS not in state.answered_s
        due = disarmed and unasked and now_s - self._found_s >= PREARM_AFTER_S
        if due and self._may_ask(RUN_PREARM_CHECKS, now_s):
            yield CommandLong.run_prearm_checks()
        if state.time_s and now_s - self._timesync_s >= TIMESYNC_EVERY_S:
            self._timesync_s = now_s
            yield self.clock.request(state.time_s, now_s)

    def _permitted(self, outgoing: Outgoing) -> bool:
        """Whether a message of the session may be sent: rate requests to a vehicle that has
        reported to be disarmed; no heartbeats."""
        known = self.vehicle.heartbeat is not None
        permitted = known and not self.vehicle.armed and isinstance(outgoing, CommandLong)
        self.rates_requested |= permitted
        return permitted

    def _may_ask(self, number: int, now_s: float) -> bool:
        if now_s - self._asked_s.get(number, -math.inf) < ASK_EVERY_S:
            return False
        self._asked_s[number] = now_s
        return True

    # --- what it has found ---

    @property
    def found(self) -> VehicleFound | None:
        return self.session.vehicle

    def complete(self, now_s: float) -> bool:
        """Whether the pass ends: all requests were answered, or its time is over."""
        state, dialect, passed_s = self.vehicle, self.session.dialect, now_s - self._listens_s
        if dialect is None:
            return passed_s >= NOTHING_S
        if now_s - self._found_s < LEAST_S or passed_s >= LONGEST_S:
            return passed_s >= LONGEST_S
        prearm_s = state.now_s - state.answered_s.get(RUN_PREARM_CHECKS, math.inf)
        checked = state.armed or prearm_s >= TEXTS_S
        return (
            checked
            and state.version is not None
            and self.clock.delay is not None
            and self.reading.complete(dialect, state)
            and not self.slow(lambda each: each.arrives_hz)
        )

    def slow(self, wanted_hz: Callable[[WantedMessage], float]) -> list[WantedMessage]:
        """Required telemetry messages that arrive at less than ENOUGH of the rate `wanted_hz`."""
        dialect, rates_hz = self.session.dialect, self.session.telemetry.rates_hz
        return [
            each
            for each in (dialect.wanted if dialect else ())
            if not each.optional and rates_hz.get(each.name, 0.0) < ENOUGH * wanted_hz(each)
        ]

    @property
    def listened_s(self) -> float:
        return self.host_s - self._listens_s

    @property
    def bytes_ps(self) -> float:
        """All received bytes per second since the vehicle was found."""
        passed_s = max(self.host_s - (self._found_s or self._listens_s), 1e-3)
        return self.senders.splitter.bytes_received / passed_s

    @property
    def has_asked(self) -> bool:
        """Whether a command was sent to which an acknowledgement is due."""
        return bool(self._asked_s.keys() - {TIMESYNC})
