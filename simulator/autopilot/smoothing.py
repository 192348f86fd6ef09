"""A point that flies to a goal under limits on jerk, acceleration and speed: one period, compiled.

As PX4's automatic flight draws its ways: each axis on its own jerk-limited change of velocity, all
timed to the longest; how fast the point may be follows from the distance to the goal and from the
corner there, and it waits for a vehicle that falls behind. Python talks to it by
`simulator.autopilot.trajectory`. Knows no vehicle and no modes.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from offboard.model.kernel import entry, kernel

_TURNING_MPS, _TURNING_COS = 0.2, 0.98  # flies more than this across, off the way to the goal
_LINE_AHEAD_M = 5.0  # back to the line between two places, this far ahead
_SLOW_MPS = 0.5  # below, an axis is limited without the others
_POINT_M, _PLACE_M = 1e-9, 1e-3  # too short to have a direction; the same place

RECORD = np.dtype(
    [
        # per axis, NED: the point's motion, and how long its jerk is +, 0 and - of `jerk`
        ("position", "f8", 3),
        ("velocity", "f8", 3),
        ("acceleration", "f8", 3),
        ("phases_s", "f8", (3, 3)),
        ("jerk", "f8", 3),
        # where to: the goal, what comes before it and behind it; no number: straight down so fast
        ("goal", "f8", 3),
        ("before", "f8", 3),
        ("behind", "f8", 3),
        ("sink_mps", "f8"),
        ("estimate", "f8", 3),
        ("lifts", "i8"),
        # and how
        ("period_s", "f8"),
        ("cruise_mps", "f8"),
        ("jerk_mps3", "f8"),
        ("across_mps2", "f8"),
        ("speed_z_mps", "f8"),
        ("speed_z_mps2", "f8"),
        ("corner_share", "f8"),
        ("accepted_m", "f8"),
        ("accepted_height_m", "f8"),
        ("behind_max_m", "f8"),
        # what comes out: the velocity wanted before it is smoothed, and the speed of a turn
        ("wanted", "f8", 3),
        ("turn_mps", "f8"),
    ],
    align=True,
)
"""All that compiled code knows of one way."""


@entry(RECORD)
def follow(way: Any) -> int:
    """One period: move the point, then choose where it tends to."""
    share = _haste(way)
    if way.lifts:
        way.position[2] = way.estimate[2]
    _want(way)
    for i in range(3):
        _move(way, i, share * way.period_s)
    for i in range(3):
        _plan(way, i)
    _time_together(way)
    return 0


@kernel
def _haste(way: Any) -> float:
    """How much of a period passes for the point: none where the vehicle is far behind."""
    north, east = way.position[0] - way.estimate[0], way.position[1] - way.estimate[1]
    if north * way.velocity[0] + east * way.velocity[1] < 0.0:
        return 1.0
    return float(1.0 - min(1.0, math.hypot(north, east) / way.behind_max_m))


@kernel
def _move(way: Any, i: int, time_s: float) -> None:
    """One axis, by its phases; behind them at constant speed."""
    for phase in range(4):
        part_s = time_s
        jerk = 0.0
        if phase < 3:
            part_s = min(time_s, way.phases_s[i, phase])
            jerk = (1.0 - phase) * way.jerk[i]
        elif part_s > 0.0:
            way.acceleration[i] = 0.0
        speed, rate = way.velocity[i], way.acceleration[i]
        way.position[i] += part_s * (speed + part_s * (0.5 * rate + part_s * jerk / 6.0))
        way.velocity[i] = speed + part_s * (rate + 0.5 * part_s * jerk)
        way.acceleration[i] = rate + part_s * jerk
        time_s -= part_s


@kernel
def _rate_max(way: Any, i: int) -> float:
    return float(way.speed_z_mps2 if i == 2 else way.across_mps2)


@kernel
def _change(way: Any, i: int) -> float:
    """Of velocity, that is left on this axis."""
    wanted = way.wanted[i]
    if i == 2:
        wanted = min(way.speed_z_mps, max(-way.speed_z_mps, wanted))
    return float(wanted - way.velocity[i])


@kernel
def _plan(way: Any, i: int) -> None:
    """The quickest change to the velocity wanted: jerk, none, the opposite jerk.

    With the acceleration a0 > 0 along the change dv, the peak is sqrt(a0^2 / 2 + jerk dv).
    """
    rate, change = way.acceleration[i], _change(way, i)
    settles = rate * abs(rate) / (2.0 * way.jerk_mps3)  # dv, were the acceleration taken back now
    sign = rate if change == settles else change - settles
    side = 0.0 if sign == 0.0 else math.copysign(1.0, sign)
    way.jerk[i] = side * way.jerk_mps3
    rate, change = side * rate, side * change
    peak = math.sqrt(max(0.0, 0.5 * rate * rate + way.jerk_mps3 * change))
    peak = max(rate, min(peak, _rate_max(way, i)))
    up_s, down_s = (peak - rate) / way.jerk_mps3, max(0.0, peak / way.jerk_mps3)
    gained = 0.5 * up_s * (rate + peak) + 0.5 * down_s * peak
    flat_s = max(0.0, (change - gained) / peak) if peak > 1e-9 else 0.0
    if side == 0.0:
        up_s = flat_s = down_s = 0.0
    way.phases_s[i, 0], way.phases_s[i, 1], way.phases_s[i, 2] = up_s, flat_s, down_s


@kernel
def _time_together(way: Any) -> None:
    """The quicker axes take as long as the slowest: a lower peak, held for longer."""
    longest_s = 0.0
    for i in range(3):
        longest_s = max(longest_s, _length(way, i))
    for i in range(3):
        if way.jerk[i] == 0.0 or _length(way, i) >= longest_s:
            continue
        side = math.copysign(1.0, way.jerk[i])
        rate, change = side * way.acceleration[i], side * _change(way, i)
        most = way.jerk_mps3 * longest_s + rate
        root = most * most - 2.0 * rate * rate - 4.0 * way.jerk_mps3 * change
        peak = rate if root < 0.0 else 0.5 * (most - math.sqrt(root))
        peak = max(rate, min(peak, _rate_max(way, i)))
        up_s, down_s = (peak - rate) / way.jerk_mps3, max(0.0, peak / way.jerk_mps3)
        way.phases_s[i, 0], way.phases_s[i, 2] = up_s, down_s
        way.phases_s[i, 1] = max(0.0, longest_s - up_s - down_s)


@kernel
def _length(way: Any, i: int) -> float:
    return float(way.phases_s[i, 0] + way.phases_s[i, 1] + way.phases_s[i, 2])


# -- how fast, and where to --------------------------------------------------------------------


@kernel
def _want(way: Any) -> None:
    """The velocity that leads to the goal and lets it stop there, or turn."""
    turning = _turns(way)
    across = _speed_across(way)
    if turning:
        across = min(across, way.turn_mps)
    else:
        way.turn_mps = across
    _direct(way, turning)
    wanted = way.wanted
    if math.isnan(way.goal[2]):
        length = math.hypot(wanted[0], wanted[1])
        for i in range(2):
            wanted[i] = across * wanted[i] / length if length > _POINT_M else 0.0
        wanted[2] = way.sink_mps
        return
    down = _speed_down(way)
    length = math.sqrt(wanted[0] ** 2 + wanted[1] ** 2 + wanted[2] ** 2)
    speed = math.hypot(across, down)
    for i in range(3):
        wanted[i] = speed * wanted[i] / length if length > _POINT_M else 0.0
    _cap(wanted, math.hypot(wanted[0], wanted[1]), across, 0)
    _cap(wanted, abs(wanted[2]), down, 2)


@kernel
def _cap(wanted: Any, speed: float, most: float, first: int) -> None:
    """Lower all three so that this speed is allowed; slow ones alone, from axis `first`."""
    if speed <= most or speed <= _POINT_M:
        return
    alone = most < _SLOW_MPS and speed < _SLOW_MPS
    begin, end = 0, 3
    if alone:
        begin, end = first, 2 if first == 0 else 3
    for i in range(begin, end):
        wanted[i] *= most / speed


@kernel
def _turns(way: Any) -> bool:
    """The point flies across the way to a goal that is not reached yet."""
    north, east = way.goal[0] - way.position[0], way.goal[1] - way.position[1]
    away, speed = math.hypot(north, east), math.hypot(way.velocity[0], way.velocity[1])
    if speed <= _TURNING_MPS or away <= way.accepted_m:
        return False
    along = north * way.velocity[0] + east * way.velocity[1]
    return bool(along < _TURNING_COS * speed * away)


@kernel
def _direct(way: Any, turning: bool) -> None:
    """From the point to the goal or, in a turn, to the line that leads there; as `wanted`, m."""
    line, length = way.wanted, 0.0
    for i in range(3):
        line[i] = way.goal[i] - way.before[i]
        if not math.isnan(line[i]):
            length += line[i] ** 2
    length = math.sqrt(length)
    if not turning or length <= _POINT_M or math.isnan(way.goal[2]):
        for i in range(3):
            line[i] = way.goal[i] - way.position[i]
        return
    done = 0.0
    for i in range(3):
        line[i] /= length
        done += line[i] * (way.position[i] - way.before[i])
    beside = 0.0
    for i in range(3):
        beside += (way.before[i] + done * line[i] - way.position[i]) ** 2
    ahead_m = max(way.accepted_m, _LINE_AHEAD_M)
    done += math.sqrt(max(0.0, ahead_m**2 - beside))
    for i in range(3):
        line[i] = way.before[i] + done * line[i] - way.position[i]


@kernel
def _speed_over(way: Any, distance_m: float, last_mps: float, rate_mps2: float) -> float:
    """From which it slows down to `last_mps` in so far, jerk included: v^2 = last^2 + 2 a (d - v
    2 a / jerk)."""
    half = 2.0 * rate_mps2**2 / way.jerk_mps3
    speed = math.sqrt(half**2 + 2.0 * rate_mps2 * distance_m + last_mps**2) - half
    return float(max(speed, last_mps))


@kernel
def _speed_round(cosine: float, rate_mps2: float, radius_m: float) -> float:
    """On the circle that touches two ways at this distance from where they meet; `cosine` of the
    angle between them."""
    cosine = min(1.0, max(-1.0 + 1e-9, cosine))
    return math.sqrt(rate_mps2 * radius_m * math.sqrt((1.0 - cosine) / (1.0 + cosine)))


@kernel
def _cosine(ahead: float, aside: float, other: float, otherside: float) -> float:
    """Of the angle between two vectors; 0 where one has no length."""
    lengths = math.hypot(ahead, aside) * math.hypot(other, otherside)
    return (ahead * other + aside * otherside) / lengths if lengths > 0.0 else 0.0


@kernel
def _speed_across(way: Any) -> float:
    """Across the ground, so that the goal's corner can be flown."""
    back_n, back_e = way.goal[0] - way.behind[0], way.goal[1] - way.behind[1]
    way_n, way_e = way.goal[0] - way.position[0], way.goal[1] - way.position[1]
    next_m, last = math.hypot(back_n, back_e), 0.0
    if next_m > _PLACE_M and next_m >= way.accepted_m:
        cosine = _cosine(way_n, way_e, back_n, back_e)
        last = _speed_round(cosine, way.corner_share * way.across_mps2, way.accepted_m)
        last = min(last, _speed_over(way, next_m, 0.0, way.across_mps2), way.cruise_mps)
    speed = _speed_over(way, math.hypot(way_n, way_e), last, way.across_mps2)
    return float(min(speed, way.cruise_mps))


@kernel
def _speed_down(way: Any) -> float:
    """Up or down, likewise; distances across are those from the origin, as PX4 takes them."""
    here, goal = math.hypot(way.position[0], way.position[1]), math.hypot(way.goal[0], way.goal[1])
    behind = math.hypot(way.behind[0], way.behind[1])
    drop, down = way.goal[2] - way.behind[2], way.goal[2] - way.position[2]
    last = 0.0
    if abs(drop) > _PLACE_M:
        cosine = _cosine(goal - here, down, goal - behind, drop)
        last = _speed_round(cosine, way.speed_z_mps2, way.accepted_height_m)
        last = min(last, way.speed_z_mps)
    return float(min(_speed_over(way, abs(down), last, way.speed_z_mps2), way.speed_z_mps))
