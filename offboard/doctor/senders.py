"""Who sends on a link, how much, and how many of the frames are lost. Sans-I/O.

Counts the frames of all senders, also of those that the session drops.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass, field

from pymavlink.dialects.v20.all import mavlink_map

from offboard.documents.arguments import join_address
from offboard.mavlink.counters import Counters
from offboard.mavlink.decode import Identity, decode_identity
from offboard.mavlink.dialects.base import TYPE_GCS
from offboard.mavlink.framing import HEARTBEAT, Frame, FrameSplitter
from offboard.mavlink.senders import is_vehicle

_TIMES = frozenset({2, 111})  # SYSTEM_TIME, TIMESYNC
_PLACES_MAX, _SENDERS_MAX = 16, 64  # a flood of addresses or ids must not use up the memory


@dataclass(slots=True)
class Sender:
    """One MAVLink sender. `identity` is that of its HEARTBEAT, None without one; `places` are the
    addresses that it sends from."""

    system_id: int
    component_id: int
    identity: Identity | None = None
    places: set[str] = field(default_factory=set)
    frames: int = 0
    times: int = 0  # TIMESYNC and SYSTEM_TIME

    @property
    def ids(self) -> tuple[int, int]:
        return self.system_id, self.component_id

    @property
    def is_autopilot(self) -> bool:
        return self.identity is not None and is_vehicle(self.identity)

    @property
    def name(self) -> str:
        is_gcs = self.identity is not None and self.identity.vehicle_type == TYPE_GCS
        kind = "autopilot" if self.is_autopilot else "ground station" if is_gcs else "component"
        return f"{kind} {self.system_id}/{self.component_id}"


class Senders:
    """Counts what arrives. `stream`: bytes arrive in any portions."""

    def __init__(self, stream: bool) -> None:
        self._stream = stream
        self._splitters: dict[Hashable, FrameSplitter] = {}
        self._senders: dict[tuple[int, int], Sender] = {}
        self._sequences: dict[tuple[int, ...], int] = {}
        self._lost: Counter[tuple[int, ...]] = Counter()  # by sender, and by system
        self.counters = Counters()
        self.message_bytes: Counter[str] = Counter()

    def receive(self, data: bytes, place: Hashable) -> None:
        """Count the frames in `data`, which came from `place`."""
        if place not in self._splitters and len(self._splitters) >= _PLACES_MAX:
            place = None
        splitter = self._splitters.get(place)
        if splitter is None:
            splitter = self._splitters[place] = FrameSplitter(self._stream, self.counters)
        for frame in splitter.split(data):
            self._count(frame, place)

    def _count(self, frame: Frame, place: Hashable) -> None:
        ids = frame.system_id, frame.component_id
        if ids not in self._senders and len(self._senders) >= _SENDERS_MAX:
            return
        sender = self._senders.setdefault(ids, Sender(*ids))
        message = mavlink_map.get(frame.message_id)
        self.message_bytes[message.msgname if message else str(frame.message_id)] += len(frame.raw)
        sender.frames += 1
        sender.places.add(join_address(*place[:2]) if isinstance(place, tuple) else str(place))
        sender.times += frame.message_id in _TIMES
        if frame.message_id == HEARTBEAT:
            sender.identity = decode_identity(frame.payload)
        for key in (ids, ids[:1]):
            gap = (frame.sequence - self._sequences.get(key, frame.sequence - 1) - 1) % 256
            self._lost[key] += gap if gap < 128 else 0  # more: out of order
            self._sequences[key] = frame.sequence

    def lost(self, sender: Sender) -> int:
        """Frames of a sender that are missing by the gaps of its sequence numbers. Components that
        share a link of an autopilot may share its sequence numbers."""
        return min(self._lost[sender.ids], self._lost[sender.ids[:1]])

    @property
    def found(self) -> list[Sender]:
        """All senders, the most talkative first."""
        return sorted(self._senders.values(), key=lambda sender: -sender.frames)
