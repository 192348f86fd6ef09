"""Where the vehicle's bytes come from, and when somebody else may be it. Knows no message.

A router (mavlink-router, MAVProxy) that is started again sends from another port. From the host of
the vehicle's peer, with the vehicle's ids, and once that peer is silent, this is the vehicle;
anything else is a stranger, and so is everybody while the peer speaks.
"""

from __future__ import annotations

from collections.abc import Hashable

from offboard.mavlink.counters import Counters
from offboard.mavlink.decode import Address
from offboard.mavlink.framing import FrameSplitter

PEER_SILENT_S = 0.5  # half of what ends a flight (`Limits.silence_s`), so that it can go on


class Peer:
    """None until it is pinned. `heard_s`: host time at which it last sent for the vehicle."""

    def __init__(self) -> None:
        self._place: Hashable | None = None
        self._vehicle: Address | None = None
        self.heard_s = 0.0

    def pin(self, place: Hashable, vehicle: Address) -> None:
        """From now on the vehicle is there."""
        self._place, self._vehicle = place, vehicle

    def is_foreign(self, place: Hashable) -> bool:
        """Whether it is somewhere else."""
        return self._vehicle is not None and place != self._place

    def moves_to(self, place: Hashable, datagram: bytes, now_s: float) -> bool:
        """Whether the vehicle speaks from there now, which pins it there."""
        if now_s - self.heard_s <= PEER_SILENT_S or not _same_host(place, self._place):
            return False
        moved = any(
            frame.verified and Address(frame.system_id, frame.component_id) == self._vehicle
            for frame in FrameSplitter(False, Counters()).split(datagram)
        )
        if moved:
            self._place = place
        return moved


def _same_host(place: Hashable, other: Hashable) -> bool:
    """Of UDP, where a place is (host, port)."""
    return isinstance(place, tuple) and isinstance(other, tuple) and place[0] == other[0]
