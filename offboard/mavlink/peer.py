"""The network address of the vehicle, and when another address takes its place.

mavlink-router and MAVProxy send from another port after a restart. A datagram comes from the
vehicle when it is from the host of the known address, holds a frame with the vehicle's ids, and the
known address, host and port, has been silent. All other addresses are foreign. The link checks that
the silence is no overflow and no pause of ours: before, it hands over no foreign datagram.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable

from offboard.mavlink.counters import Counters
from offboard.mavlink.decode import Address
from offboard.mavlink.framing import Frame, FrameSplitter

PEER_SILENT_S = 0.5  # half of `Limits.silence_s`, so that the flight can continue


class Peer:
    """The vehicle's address, unknown until `pin`. `heard_s`: host time of its newest frame."""

    def __init__(self) -> None:
        self._place: Hashable | None = None
        self._vehicle: Address | None = None
        self.heard_s = 0.0

    def pin(self, place: Hashable, vehicle: Address) -> None:
        """The vehicle with these ids sends from `place`."""
        self._place, self._vehicle = place, vehicle

    def is_foreign(self, place: Hashable) -> bool:
        return self._vehicle is not None and place != self._place

    def moves_to(
        self,
        place: Hashable,
        datagram: bytes,
        now_s: float,
        is_genuine: Callable[[Frame], bool] = lambda frame: frame.verified,
    ) -> bool:
        """Whether `datagram` shows that the vehicle sends from `place` now; if so, pin it there.
        `is_genuine` tells whether a frame may be the vehicle's."""
        if now_s - self.heard_s <= PEER_SILENT_S or not same_host(place, self._place):
            return False
        moved = any(
            is_genuine(frame) and Address(frame.system_id, frame.component_id) == self._vehicle
            for frame in FrameSplitter(False, Counters()).split(datagram)
        )
        if moved:
            self._place = place
        return moved


def same_host(place: Hashable, other: Hashable) -> bool:
    """Whether two UDP addresses (host, port) have the same host."""
    return isinstance(place, tuple) and isinstance(other, tuple) and place[0] == other[0]
