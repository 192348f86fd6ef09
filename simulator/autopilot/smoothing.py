"""Trajectory of a point that flies to a target within limits on jerk, acceleration and speed.

After PX4's PositionSmoothing and VelocitySmoothing. Each axis changes its velocity within a jerk
limit, in the time that the slowest axis needs. The speed follows from the distance to the target
and from the corner there; the point waits for a vehicle that is far behind. Plain floats, NED, SI.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from simulator.autopilot.position_loop import horizontal
from simulator.firmware.base import PathLimits
from simulator.firmware.values import Triple
from simulator.steps import LOOP_S

_TURN_MPS, _TURN_COS = 0.2, 0.98  # a turn: faster than this, off the direction to the target
_LINE_AHEAD_M = 5.0  # in a turn: back to the line between two places, this far ahead
_SLOW_MPS = 0.5  # below, an axis is limited without the others
_POINT_M, _SAME_PLACE_M = 1e-9, 1e-3  # too short to have a direction; not another place


@dataclass(frozen=True, slots=True)
class Target:
    """Target of one period and the speeds on the way there; places NED, m."""

    place: Triple  # NaN as height: descend with `descent_mps`
    previous: Triple  # the target before it, or NaN
    following: Triple  # the target after it, reached without a stop, or NaN
    descent_mps: float
    follows_height: bool  # the height of the point is that of the vehicle
    cruise_mps: float
    speed_z_mps: float
    acceleration_z_mps2: float
    acceptance_m: float  # radius


@dataclass(slots=True)
class Axis:
    """Motion along one axis, and the phases of its jerk (+, 0, -) that are left to fly."""

    position_m: float = 0.0
    velocity_mps: float = 0.0
    acceleration_mps2: float = 0.0
    jerk_mps3: float = 0.0  # of the first phase, signed
    phases_s: Triple = (0.0, 0.0, 0.0)

    @property
    def duration_s(self) -> float:
        return self.phases_s[0] + self.phases_s[1] + self.phases_s[2]

    def move(self, time_s: float) -> None:
        """Fly the phases, then at constant speed."""
        for phase_s, sign in zip(self.phases_s, (1.0, 0.0, -1.0), strict=True):
            part_s = min(time_s, phase_s)
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
        least = rate * abs(rate) / (2.0 * jerk)  # dv while the acceleration ends
        sign = rate if change == least else change - least
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
        self, duration_s: float, change_mps: float, acceleration_max: float, jerk: float
    ) -> None:
        """The same change in this time: a lower peak, held for longer."""
        if self.jerk_mps3 == 0.0 or self.duration_s >= duration_s:
            return
        side = math.copysign(1.0, self.jerk_mps3)
        rate, change = side * self.acceleration_mps2, side * change_mps
        most = jerk * duration_s + rate
        root = most * most - 2.0 * rate * rate - 4.0 * jerk * change
        peak = rate if root < 0.0 else 0.5 * (most - math.sqrt(root))
        peak = max(rate, min(peak, acceleration_max))
        up_s, down_s = (peak - rate) / jerk, max(0.0, peak / jerk)
        self.phases_s = (up_s, max(0.0, duration_s - up_s - down_s), down_s)


@dataclass(slots=True)
class Point:
    """The point: its three axes, and the velocity that leads it to the target."""

    axes: tuple[Axis, Axis, Axis] = field(default_factory=lambda: (Axis(), Axis(), Axis()))
    goal_ned_mps: Triple = (0.0, 0.0, 0.0)
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

    def start(self, position_ned_m: Triple, velocity_ned_mps: Triple) -> None:
        """Begin with this motion, without acceleration."""
        north, east, down = map(Axis, position_ned_m, velocity_ned_mps)
        self.axes, self._turn_mps = (north, east, down), 0.0

    def move_to(self, position_ned_m: Triple) -> None:
        """Continue from another place with the same velocity."""
        for axis, position in zip(self.axes, position_ned_m, strict=True):
            axis.position_m = position

    def follow(self, target: Target, limits: PathLimits, vehicle_ned_m: Triple) -> None:
        """One period of LOOP_S: move, then plan the change to the velocity that leads on."""
        share = self._time_share(limits, vehicle_ned_m)
        if target.follows_height:
            self.axes[2].position_m = vehicle_ned_m[2]
        north, east, down = self.goal_ned_mps = self._velocity_to(target, limits)
        speed_z, jerk = target.speed_z_mps, limits.jerk_mps3
        goals = (north, east, min(speed_z, max(-speed_z, down)))
        most = (limits.across_mps2, limits.across_mps2, target.acceleration_z_mps2)
        for axis in self.axes:
            axis.move(share * LOOP_S)
        changes = [goal - axis.velocity_mps for goal, axis in zip(goals, self.axes, strict=True)]
        for axis, change, rate in zip(self.axes, changes, most, strict=True):
            axis.plan(change, rate, jerk)
        longest_s = max(axis.duration_s for axis in self.axes)
        for axis, change, rate in zip(self.axes, changes, most, strict=True):
            axis.stretch(longest_s, change, rate, jerk)

    def _time_share(self, limits: PathLimits, vehicle_ned_m: Triple) -> float:
        """Share of a period by which the point moves: 0 where the vehicle is far behind."""
        (x, y, _), (vx, vy, _) = self.position_ned_m, self.velocity_ned_mps
        north, east = x - vehicle_ned_m[0], y - vehicle_ned_m[1]
        if north * vx + east * vy < 0.0:
            return 1.0
        return 1.0 - min(1.0, horizontal(north, east) / limits.behind_max_m)

    def _velocity_to(self, target: Target, limits: PathLimits) -> Triple:
        """Velocity with which the point can still stop at the target, or turn there."""
        here = self.position_ned_m
        turning = self._turns(target)
        across = _speed_across(here, target, limits)
        if turning:
            across = min(across, self._turn_mps)
        else:
            self._turn_mps = across
        north, east, down = _direction(here, target, turning)
        length = horizontal(north, east)
        if math.isnan(target.place[2]):
            if length <= _POINT_M:
                return 0.0, 0.0, target.descent_mps
            return across * north / length, across * east / length, target.descent_mps
        speed_z = _speed_z(here, target, limits)
        length = math.sqrt(north * north + east * east + down * down)
        speed = horizontal(across, speed_z)
        velocity = (0.0, 0.0, 0.0)
        if length > _POINT_M:
            velocity = (speed * north / length, speed * east / length, speed * down / length)
        velocity = _limited(velocity, horizontal(*velocity[:2]), across, (0, 1))
        return _limited(velocity, abs(velocity[2]), speed_z, (2,))

    def _turns(self, target: Target) -> bool:
        """The point does not fly towards a target that it has not reached."""
        (x, y, _), (vx, vy, _) = self.position_ned_m, self.velocity_ned_mps
        north, east = target.place[0] - x, target.place[1] - y
        distance, speed = horizontal(north, east), horizontal(vx, vy)
        if speed <= _TURN_MPS or distance <= target.acceptance_m:
            return False
        return north * vx + east * vy < _TURN_COS * speed * distance


def _minus(place: Triple, other: Triple) -> Triple:
    return place[0] - other[0], place[1] - other[1], place[2] - other[2]


def _direction(here: Triple, target: Target, turning: bool) -> Triple:
    """Vector from the point to the target or, in a turn, to a point on the line to it; m."""
    start = target.previous
    x, y, z = _minus(target.place, start)
    length = math.sqrt(x * x + y * y + z * z)
    if not turning or not length > _POINT_M:  # NaN: no line, or no height
        return _minus(target.place, here)
    x, y, z = x / length, y / length, z / length
    a, b, c = _minus(here, start)
    done = x * a + y * b + z * c
    nearest = (start[0] + done * x, start[1] + done * y, start[2] + done * z)
    north, east, down = _minus(nearest, here)
    ahead_m = max(target.acceptance_m, _LINE_AHEAD_M)
    beside = north * north + east * east + down * down  # squared distance from the line
    done += math.sqrt(max(0.0, ahead_m * ahead_m - beside))
    return _minus((start[0] + done * x, start[1] + done * y, start[2] + done * z), here)


def _limited(velocity: Triple, speed: float, most: float, axes: tuple[int, ...]) -> Triple:
    """Scaled so that this speed is allowed; a slow one is scaled on its own axes alone."""
    if speed <= most or speed <= _POINT_M:
        return velocity
    alone = most < _SLOW_MPS and speed < _SLOW_MPS
    scale = most / speed
    north, east, down = (
        part * scale if not alone or i in axes else part for i, part in enumerate(velocity)
    )
    return north, east, down


def _braking_mps(distance_m: float, final_mps: float, rate_mps2: float, jerk_mps3: float) -> float:
    """Speed from which it slows down to `final_mps` within this distance, jerk included:
    v^2 = final^2 + 2 a (d - v 2 a / jerk)."""
    half = 2.0 * (rate_mps2 * rate_mps2) / jerk_mps3
    squared = half * half + 2.0 * rate_mps2 * distance_m + final_mps * final_mps
    return max(math.sqrt(squared) - half, final_mps)


def _corner_mps(cosine: float, rate_mps2: float, radius_m: float) -> float:
    """Speed on the circle that touches two legs at this distance from their corner; `cosine` of
    the angle between them."""
    cosine = min(1.0, max(-1.0 + 1e-9, cosine))
    return math.sqrt(rate_mps2 * radius_m * math.sqrt((1.0 - cosine) / (1.0 + cosine)))


def _cosine(x: float, y: float, other_x: float, other_y: float) -> float:
    """Cosine of the angle between two vectors; 0 where one has no length."""
    lengths = horizontal(x, y) * horizontal(other_x, other_y)
    return (x * other_x + y * other_y) / lengths if lengths > 0.0 else 0.0


def _speed_across(here: Triple, target: Target, limits: PathLimits) -> float:
    """Speed across the ground at which the corner at the target can be flown."""
    place, rate, jerk = target.place, limits.across_mps2, limits.jerk_mps3
    way, back = _minus(place, here)[:2], _minus(place, target.following)[:2]
    following_m, final = horizontal(*back), 0.0
    if following_m > _SAME_PLACE_M and following_m >= target.acceptance_m:
        corner = _corner_mps(_cosine(*way, *back), limits.corner_share * rate, target.acceptance_m)
        final = min(corner, _braking_mps(following_m, 0.0, rate, jerk), target.cruise_mps)
    return min(_braking_mps(horizontal(*way), final, rate, jerk), target.cruise_mps)


def _speed_z(here: Triple, target: Target, limits: PathLimits) -> float:
    """Vertical speed at which the corner can be flown. Horizontal distances are those from the
    origin, as in PX4."""
    place, following, rate = target.place, target.following, target.acceleration_z_mps2
    across, goal, beyond = (horizontal(*point[:2]) for point in (here, place, following))
    drop, down = place[2] - following[2], place[2] - here[2]
    final = 0.0
    if abs(drop) > _SAME_PLACE_M:
        cosine = _cosine(goal - across, down, goal - beyond, drop)
        final = min(_corner_mps(cosine, rate, limits.accepted_height_m), target.speed_z_mps)
    return min(_braking_mps(abs(down), final, rate, limits.jerk_mps3), target.speed_z_mps)
