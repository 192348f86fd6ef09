"""Census: who sends on a link, how much, and how many of its frames are lost. Sans-I/O.

Counts the frames of all senders, also of those that the session drops.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass, field

from pymavlink.dialects.v20.ardupilotmega import mavlink_map

from offboard.doctor.observation import Sender
from offboard.mavlink.counters import Counters
from offboard.mavlink.decode import decode_identity
from offboard.mavlink.framing import SETPOINTS, Frame, FrameSplitter

_HEARTBEAT = 0
_TIMES = frozenset({2, 111})  # SYSTEM_TIME, TIMESYNC
_PLACES_MAX, _SENDERS_MAX = 16, 64  # a flood of addresses or ids must not use up the memory


@dataclass(slots=True)
class _Count:
    vehicle_type: int | None = None
    autopilot: int | None = None
    places: set[str] = field(default_factory=set)
    frames: int = 0
    lost: int = 0
    setpoints: int = 0
    times: int = 0
    sequence: int | None = None

    def follow(self, sequence: int) -> None:
        """The next frame has this sequence number."""
        if self.sequence is not None:
            gap = (sequence - self.sequence - 1) % 256
            self.lost += gap if gap < 128 else 0  # more: out of order
        self.sequence = sequence


class Census:
    """Counts what arrives. `stream`: bytes arrive in any portions."""

    def __init__(self, stream: bool) -> None:
        self._stream = stream
        self._splitters: dict[Hashable, FrameSplitter] = {}
        self._counts: dict[tuple[int, int], _Count] = {}
        self._together: dict[int, _Count] = {}  # the components of a system as one sender
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
            if frame.verified:
                self._count(frame, place)

    def _count(self, frame: Frame, place: Hashable) -> None:
        ids = frame.system_id, frame.component_id
        if ids not in self._counts and len(self._counts) >= _SENDERS_MAX:
            return
        count = self._counts.setdefault(ids, _Count())
        message = mavlink_map.get(frame.message_id)
        self.message_bytes[message.msgname if message else str(frame.message_id)] += len(frame.raw)
        count.frames += 1
        count.places.add(_name(place))
        count.setpoints += frame.message_id in SETPOINTS
        count.times += frame.message_id in _TIMES
        if frame.message_id == _HEARTBEAT:
            count.vehicle_type, count.autopilot = decode_identity(frame.payload)
        count.follow(frame.sequence)
        self._together.setdefault(frame.system_id, _Count()).follow(frame.sequence)

    @property
    def senders(self) -> tuple[Sender, ...]:
        """All senders, the most talkative first."""
        found = (
            Sender(
                *ids,
                count.vehicle_type,
                count.autopilot,
                tuple(sorted(count.places)),
                count.frames,
                # components that share a link of an autopilot may share its sequence numbers
                min(count.lost, self._together[ids[0]].lost),
                count.setpoints,
                count.times,
            )
            for ids, count in self._counts.items()
        )
        return tuple(sorted(found, key=lambda sender: -sender.frames))


def _name(place: Hashable) -> str:
    return ":".join(map(str, place[:2])) if isinstance(place, tuple) else str(place)
