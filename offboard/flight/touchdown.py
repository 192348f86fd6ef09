"""Touch-down: whether a vehicle has landed, by its land detector, its height and its speed.

Used in flight and by the score, so that both give the same verdict. No clock, no I/O.
"""

from __future__ import annotations

import math
import operator
from collections import deque
from collections.abc import Iterable

Triple = tuple[float, float, float]

HARD_MPS = 2.0  # faster than any landing; reached after a fall of 0.2 m
REST_S = 0.5  # at rest: for so long the height stays
REST_M = 0.15  # within this range; a single estimated speed is too noisy
BEFORE_S = 1.0  # a fall of 5 m
BOUNCE_M = 0.3
ABOVE_TAKEOFF_M = 1.5  # for the drift of the estimated height
SLOPE = 0.1  # of the terrain


def moved(point_ned_m: Triple, jump_ned_m: Iterable[float]) -> Triple:
    """A place on the ground after the reported position has jumped by `jump_ned_m` (3,)."""
    north, east, down = map(operator.add, point_ned_m, jump_ned_m)
    return north, east, down


class Touchdown:
    """One landing. Give it each position from the beginning of the landing on, and each jump of the
    reported position (`position_jumps`) before it: they move the ground as well.

    `takeoff_ned_m` is the take-off point; None if unknown, then the height is not judged.
    `speed_mps` is the largest downward speed within a second before the vehicle came to rest where
    it is, NaN before it has. It may bounce there.
    """

    def __init__(self, takeoff_ned_m: Triple | None) -> None:
        self._takeoff_ned_m = takeoff_ned_m
        self._newest: deque[tuple[float, float, float]] = deque()  # time, down, downward speed
        self._position_ned_m: Triple = (math.nan,) * 3
        self._reported: tuple[Triple, float] | None = None
        self._rest_down_m = math.nan
        self.speed_mps = math.nan

    def on_position(self, time_s: float, position_ned_m: Triple, down_mps: float) -> None:
        """A position, and the downward component of the velocity."""
        if (position_ned_m, down_mps) == self._reported:
            return  # no estimator reports the same twice: it has stopped
        self._reported = position_ned_m, down_mps
        self._position_ned_m, down_m = position_ned_m, position_ned_m[2]
        newest = self._newest
        newest.append((time_s, down_m, down_mps))
        while newest[0][0] < time_s - BEFORE_S - REST_S:
            newest.popleft()
        if self._rests(time_s):
            fastest_mps = max(speed for _, _, speed in newest)
            if not self.speed_mps >= fastest_mps:
                self.speed_mps = fastest_mps
            self._rest_down_m = down_m
        elif abs(down_m - self._rest_down_m) > BOUNCE_M:
            self.speed_mps = math.nan

    def on_jump(self, jump_ned_m: Iterable[float]) -> None:
        """The reported position has jumped by this (3,), and with it all places on the ground."""
        jump = tuple(jump_ned_m)
        self._rest_down_m += jump[2]
        self._newest = deque((at_s, down + jump[2], mps) for at_s, down, mps in self._newest)
        if self._takeoff_ned_m is not None:
            self._takeoff_ned_m = moved(self._takeoff_ned_m, jump)

    def _rests(self, time_s: float) -> bool:
        downs = [down for at_s, down, _ in self._newest if at_s >= time_s - REST_S]
        known = self._newest[0][0] <= time_s - REST_S
        return known and max(downs) - min(downs) <= REST_M

    def not_landed(self, *, on_ground: bool) -> str:
        """Why the vehicle has not landed; empty if it has. `on_ground`: its land detector says so,
        in a report younger than the touch-down."""
        fastest_mps = max((speed for _, _, speed in self._newest), default=0.0)
        if self.speed_mps > HARD_MPS or fastest_mps > HARD_MPS:
            return f"fell at up to {max(fastest_mps, self.speed_mps):.1f} m/s"
        if not on_ground:
            return "the land detector does not report the ground"
        if math.isnan(self.speed_mps):
            return "it has not come to rest"
        height_m, limit_m = self._height_m(), ABOVE_TAKEOFF_M
        if self._takeoff_ned_m is not None:
            limit_m += SLOPE * math.dist(self._takeoff_ned_m[:2], self._position_ned_m[:2])
        if height_m > limit_m:
            return f"{height_m:.1f} m above the take-off point"
        return ""

    def _height_m(self) -> float:
        if self._takeoff_ned_m is None:
            return 0.0
        return self._takeoff_ned_m[2] - self._position_ned_m[2]
