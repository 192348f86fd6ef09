"""A point that flies to a target under limits on jerk, acceleration and speed.

As PX4's automatic flight plans it (PositionSmoothing, VelocitySmoothing): each axis on its own
jerk-limited change of velocity, all timed to the longest; the speed follows from the distance to
the target and from the corner there, and the point waits for a vehicle that falls behind. Plain
floats, NED, SI. Knows no vehicle and no modes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from simulator.autopilot.position_law import horizontal, or_zero
from simulator.firmware.base import PathLimits
from simulator.firmware.values import Triple
from simulator.steps import LOOP_S

_TURNING_MPS, _TURNING_COS = 0.2, 0.98  # a turn: faster than this, off the way to the target
_LINE_AHEAD_M = 5.0  # in a turn: back to the line between two places, this far ahead
_SLOW_MPS = 0.5  # below, an axis is limited without the others
_POINT_M, _PLACE_M = 1e-9, 1e-3  # too short to have a direction; the same place


@dataclass(frozen=True, slots=True)
class Target:
    """Where the point flies in one period, and how fast; places NED, m."""

    place: Triple  # NaN as height: sink there with `sink_mps`
    before: Triple  # the place before it; the same: none
    after: Triple  # the one to fly to without a stop; the same: none
    sink_mps: float
    follows_height: bool  # the point's height is the vehicle's
    cruise_mps: float
    speed_z_mps: float
    acceleration_z_mps2: float
    accepted_m: float  # radius of acceptance


@dataclass(slots=True)
class Axis:
    """Motion along one axis, and the phases of its jerk (+, 0, -) that are left to fly."""

    position_m: float = 0.0
    velocity_mps: float = 0.0
    acceleration_mps2: float = 0.0
    jerk_mps3: float = 0.0  # signed, of the first phase
    phases_s: Triple = (0.0, 0.0, 0.0)

    @property
    def length_s(self) -> float:
        """Until the velocity wanted is reached."""
        return self.phases_s[0] + self.phases_s[1] + self.phases_s[2]

    def stand(self, position_m: float, velocity_mps: float) -> None:
        """Begin with this motion, without acceleration."""
        self.position_m, self.velocity_mps = position_m, velocity_mps
        self.acceleration_mps2, self.phases_s = 0.0, (0.0, 0.0, 0.0)

    def move(self, time_s: float) -> None:
        """Fly the phases, then at constant speed."""
        for length_s, sign in zip(self.phases_s, (1.0, 0.0, -1.0), strict=True):
            part_s = min(time_s, length_s)
            self._integrate(part_s, sign * self.jerk_mps3)
            time_s -= part_s
        if time_s > 0.0:
            self.acceleration_mps2 = 0.0
        self._integrate(time_s, 0.0)

    def _integrate(self, time_s: float, jerk_mps3: float) -> None:
        v, a = self.velocity_mps, self.acceleration_mps2
        self.position_m += time_s * (v + time_s * (0.5 * a + time_s * jerk_mps3 / 6.0))
        self.velocity_mps = v + time_s * (a + 0.5 * time_s * jerk_mps3)
        self.acceleration_mps2 = a + time_s * jerk_mps3

    def plan(self, change_mps: float, acceleration_max: float, jerk: float) -> None:
        """Quickest change of velocity by `change_mps`: jerk, none, the opposite jerk.

        With the acceleration a0 along the change dv, the peak is sqrt(a0^2 / 2 + jerk dv).
        """
        rate, change = self.acceleration_mps2, change_mps
        settles = rate * abs(rate) / (2.0 * jerk)  # dv if the acceleration ended now
        sign = rate if change == settles else change - settles
        side = 0.0 if sign == 0.0 else math.copysign(1.0, sign)
        self.jerk_mps3 = side * jerk
        if side == 0.0:
            self.phases_s = (0.0, 0.0, 0.0)
            return
        rate, change = side * rate, side * change
        peak = math.sqrt(max(0.0, 0.5 * rate * rate + jerk * change))
        peak = max(rate, min(peak, acceleration_max))
        up_s, down_s = (peak - rate) / jerk, max(0.0, peak / jerk)
        gained = 0.5 * up_s * (rate + peak) + 0.5 * down_s * peak
        flat_s = max(0.0, (change - gained) / peak) if peak > 1e-9 else 0.0
        self.phases_s = (up_s, flat_s, down_s)

    def stretch(
        self, length_s: float, change_mps: float, acceleration_max: float, jerk: float
    ) -> None:
        """Take this long for the same change: a lower peak, held for longer."""
        if self.jerk_mps3 == 0.0 or self.length_s >= length_s:
            return
        side = math.copysign(1.0, self.jerk_mps3)
        rate, change = side * self.acceleration_mps2, side * change_mps
        most = jerk * length_s + rate
        root = most * most - 2.0 * rate * rate - 4.0 * jerk * change
        peak = rate if root < 0.0 else 0.5 * (most - math.sqrt(root))
        peak = max(rate, min(peak, acceleration_max))
        up_s, down_s = (peak - rate) / jerk, max(0.0, peak / jerk)
        self.phases_s = (up_s, max(0.0, length_s - up_s - down_s), down_s)


@dataclass(slots=True)
class Point:
    """The point: its three axes, and the velocity that it was to reach in the last period."""

    axes: tuple[Axis, Axis, Axis] = field(default_factory=lambda: (Axis(), Axis(), Axis()))
    wanted_ned_mps: Triple = (0.0, 0.0, 0.0)
    _turn_mps: float = 0.0  # across the ground, at the beginning of a turn

    @property
    def position_ned_m(self) -> Triple:
        north, east, down = self.axes
        return north.position_m, east.position_m, down.position_m

    @property
    def velocity_ned_mps(self) -> Triple:
        north, east, down = self.axes
        return north.velocity_mps, east.velocity_mps, down.velocity_mps

    @property
    def acceleration_ned_mps2(self) -> Triple:
        north, east, down = self.axes
        return north.acceleration_mps2, east.acceleration_mps2, down.acceleration_mps2

    def stand(self, position_ned_m: Triple, velocity_ned_mps: Triple) -> None:
        """Begin with this motion, without acceleration."""
        for axis, position, velocity in zip(
            self.axes, position_ned_m, velocity_ned_mps, strict=True
        ):
            axis.stand(position, velocity)
        self._turn_mps = 0.0

    def move_to(self, position_ned_m: Triple) -> None:
        """Continue from another place with the same velocity."""
        for axis, position in zip(self.axes, position_ned_m, strict=True):
            axis.position_m = position

    def follow(self, target: Target, limits: PathLimits, estimate_ned_m: Triple) -> None:
        """One period of LOOP_S: move, then plan the way to the velocity wanted."""
        share = self._time_share(limits, estimate_ned_m)
        if target.follows_height:
            self.axes[2].position_m = estimate_ned_m[2]
        wanted = self._velocity_wanted(target, limits)
        self.wanted_ned_mps = wanted
        speed_z, jerk = target.speed_z_mps, limits.jerk_mps3
        goals = (wanted[0], wanted[1], min(speed_z, max(-speed_z, wanted[2])))
        most = (limits.across_mps2, limits.across_mps2, target.acceleration_z_mps2)
        for axis in self.axes:
            axis.move(share * LOOP_S)
        changes = [goal - axis.velocity_mps for goal, axis in zip(goals, self.axes, strict=True)]
        for axis, change, rate in zip(self.axes, changes, most, strict=True):
            axis.plan(change, rate, jerk)
        longest_s = max(axis.length_s for axis in self.axes)
        for axis, change, rate in zip(self.axes, changes, most, strict=True):
            axis.stretch(longest_s, change, rate, jerk)

    def _time_share(self, limits: PathLimits, estimate_ned_m: Triple) -> float:
        """Share of a period that passes for the point: none where the vehicle is far behind."""
        (x, y, _), (vx, vy, _) = self.position_ned_m, self.velocity_ned_mps
        north, east = x - estimate_ned_m[0], y - estimate_ned_m[1]
        if north * vx + east * vy < 0.0:
            return 1.0
        return 1.0 - min(1.0, horizontal(north, east) / limits.behind_max_m)

    def _velocity_wanted(self, target: Target, limits: PathLimits) -> Triple:
        """Velocity that leads to the target and lets the point stop there, or turn."""
        here = self.position_ned_m
        turning = self._turns(target)
        across = _speed_across(here, target, limits)
        if turning:
            across = min(across, self._turn_mps)
        else:
            self._turn_mps = across
        north, east, down = _direction(here, target, turning)
        if math.isnan(target.place[2]):
            length = horizontal(north, east)
            if length <= _POINT_M:
                return 0.0, 0.0, target.sink_mps
            return across * north / length, across * east / length, target.sink_mps
        speed_z = _speed_z(here, target, limits)
        length = math.sqrt(north * north + east * east + down * down)
        speed = horizontal(across, speed_z)
        wanted = (0.0, 0.0, 0.0)
        if length > _POINT_M:
            wanted = (speed * north / length, speed * east / length, speed * down / length)
        wanted = _capped(wanted, horizontal(wanted[0], wanted[1]), across, (0, 1))
        return _capped(wanted, abs(wanted[2]), speed_z, (2,))

    def _turns(self, target: Target) -> bool:
        """The point flies off the way to a target that is not reached yet."""
        (x, y, _), (vx, vy, _) = self.position_ned_m, self.velocity_ned_mps
        north, east = target.place[0] - x, target.place[1] - y
        away, speed = horizontal(north, east), horizontal(vx, vy)
        if speed <= _TURNING_MPS or away <= target.accepted_m:
            return False
        return north * vx + east * vy < _TURNING_COS * speed * away


def _direction(here: Triple, target: Target, turning: bool) -> Triple:
    """Vector from the point to the target or, in a turn, to the line that leads there; m."""
    place, before = target.place, target.before
    x, y, z = place[0] - before[0], place[1] - before[1], place[2] - before[2]
    length = math.sqrt(or_zero(x * x) + or_zero(y * y) + or_zero(z * z))
    if not turning or length <= _POINT_M or math.isnan(place[2]):
        return place[0] - here[0], place[1] - here[1], place[2] - here[2]
    x, y, z = x / length, y / length, z / length
    done = x * (here[0] - before[0]) + y * (here[1] - before[1]) + z * (here[2] - before[2])
    north = before[0] + done * x - here[0]
    east = before[1] + done * y - here[1]
    down = before[2] + done * z - here[2]
    beside = north * north + east * east + down * down  # squared distance from the line
    ahead_m = max(target.accepted_m, _LINE_AHEAD_M)
    done += math.sqrt(max(0.0, ahead_m * ahead_m - beside))
    return (
        before[0] + done * x - here[0],
        before[1] + done * y - here[1],
        before[2] + done * z - here[2],
    )


def _capped(wanted: Triple, speed: float, most: float, axes: tuple[int, ...]) -> Triple:
    """Scaled so that this speed is allowed; a slow one is lowered on its own axes alone."""
    if speed <= most or speed <= _POINT_M:
        return wanted
    alone = most < _SLOW_MPS and speed < _SLOW_MPS
    scale = most / speed
    north, east, down = (
        part * scale if not alone or i in axes else part for i, part in enumerate(wanted)
    )
    return north, east, down


def _braking_mps(distance_m: float, last_mps: float, rate_mps2: float, jerk_mps3: float) -> float:
    """Speed from which it slows down to `last_mps` within this distance, jerk included:
    v^2 = last^2 + 2 a (d - v 2 a / jerk)."""
    half = 2.0 * (rate_mps2 * rate_mps2) / jerk_mps3
    squared = half * half + 2.0 * rate_mps2 * distance_m + last_mps * last_mps
    return max(math.sqrt(squared) - half, last_mps)


def _corner_mps(cosine: float, rate_mps2: float, radius_m: float) -> float:
    """Speed on the circle that touches two legs at this distance from where they meet; `cosine` of
    the angle between them."""
    cosine = min(1.0, max(-1.0 + 1e-9, cosine))
    return math.sqrt(rate_mps2 * radius_m * math.sqrt((1.0 - cosine) / (1.0 + cosine)))


def _cosine(x: float, y: float, other_x: float, other_y: float) -> float:
    """Cosine of the angle between two vectors; 0 where one has no length."""
    lengths = horizontal(x, y) * horizontal(other_x, other_y)
    return (x * other_x + y * other_y) / lengths if lengths > 0.0 else 0.0


def _speed_across(here: Triple, target: Target, limits: PathLimits) -> float:
    """Speed across the ground at which the corner at the target can be flown."""
    place, after, rate, jerk = target.place, target.after, limits.across_mps2, limits.jerk_mps3
    back = (place[0] - after[0], place[1] - after[1])
    way = (place[0] - here[0], place[1] - here[1])
    next_m, last = horizontal(*back), 0.0
    if next_m > _PLACE_M and next_m >= target.accepted_m:
        corner = _corner_mps(_cosine(*way, *back), limits.corner_share * rate, target.accepted_m)
        last = min(corner, _braking_mps(next_m, 0.0, rate, jerk), target.cruise_mps)
    return min(_braking_mps(horizontal(*way), last, rate, jerk), target.cruise_mps)


def _speed_z(here: Triple, target: Target, limits: PathLimits) -> float:
    """Vertical speed, likewise; distances across are those from the origin, as PX4 takes them."""
    place, after, rate = target.place, target.after, target.acceleration_z_mps2
    across, goal = horizontal(here[0], here[1]), horizontal(place[0], place[1])
    beyond = horizontal(after[0], after[1])
    drop, down = place[2] - after[2], place[2] - here[2]
    last = 0.0
    if abs(drop) > _PLACE_M:
        cosine = _cosine(goal - across, down, goal - beyond, drop)
        last = min(_corner_mps(cosine, rate, limits.accepted_height_m), target.speed_z_mps)
    speed = _braking_mps(abs(down), last, rate, limits.jerk_mps3)
    return min(speed, target.speed_z_mps)
