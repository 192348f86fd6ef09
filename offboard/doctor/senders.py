"""Who sends on a link, how much, and how many of the frames are lost. Sans-I/O.

Counts the frames of all senders, also of those that the session drops.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable

from pymavlink.dialects.v20.all import mavlink_map

from offboard.doctor.observation import Sender
from offboard.documents.arguments import join_address
from offboard.mavlink.counters import Counters
from offboard.mavlink.decode import decode_identity
from offboard.mavlink.framing import HEARTBEAT, Frame, FrameSplitter

_TIMES = frozenset({2, 111})  # SYSTEM_TIME, TIMESYNC
_PLACES_MAX, _SENDERS_MAX = 16, 64  # a flood of addresses or ids must not use up the memory


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
        sender.places.add(_name(place))
        sender.times += frame.message_id in _TIMES
        if frame.message_id == HEARTBEAT:
            sender.vehicle_type, sender.autopilot = decode_identity(frame.payload)
        self._follow(ids, frame.sequence)
        self._follow(ids[:1], frame.sequence)

    def _follow(self, key: tuple[int, ...], sequence: int) -> None:
        """The next frame of a sender, or of a system, has this sequence number."""
        gap = (sequence - self._sequences.get(key, sequence - 1) - 1) % 256
        self._lost[key] += gap if gap < 128 else 0  # more: out of order
        self._sequences[key] = sequence

    @property
    def found(self) -> tuple[Sender, ...]:
        """All senders, the most talkative first."""
        for ids, sender in self._senders.items():
            # components that share a link of an autopilot may share its sequence numbers
            sender.lost = min(self._lost[ids], self._lost[ids[:1]])
        return tuple(sorted(self._senders.values(), key=lambda sender: -sender.frames))


def _name(place: Hashable) -> str:
    return join_address(*place[:2]) if isinstance(place, tuple) else str(place)
