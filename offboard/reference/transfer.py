"""Flights from a start, at rest or moving, to rest at a target: used for the climb after takeoff
and for the way back after a jump of the estimate.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.reference.path import Spline, joined
from offboard.reference.track import Track

Array = NDArray[np.float64]
Vector = Array | Iterable[float]

_DURATION_MIN_S = 0.5
_GROWTH = 1.08
_CRUISE_FROM_S = 15.0  # a transfer that takes longer with one polynomial is flown in three legs
_RAMPS_SHARE = 0.6  # greatest share of the distance for acceleration and braking
_SMOOTH_PEAK = 35.0 / 16.0  # greatest slope of the smoothstep of degree 7
_BRAKE_MIN_S = 1.5
_CREEP_MPS = 0.5  # up to this speed a start needs no braking
_LEVEL_M = 0.5  # a way between heights that differ by less is straight
_AHEAD = 0.7  # least cosine between the start's velocity and the direction of the target


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a transfer."""

    speed_mps: float = 1.5
    acceleration_mps2: float = 2.0
    heading_rate_radps: float = 0.8
    # Constant speed of a long transfer between its run-in and run-out (PX4: MPC_XY_CRUISE 5 m/s,
    # MPC_Z_V_AUTO_DN 1.5 m/s)
    cruise_mps: float = 4.0
    cruise_vertical_mps: float = 1.5


def stopping_place(position_ned_m: Vector, velocity_ned_mps: Vector) -> Array:
    """Return where a vehicle at this position (3,), with this velocity (3,), NED, comes to rest if
    it brakes smoothly within the default `Limits`."""
    velocity = np.asarray(list(velocity_ned_mps), dtype=np.float64)
    return np.asarray(list(position_ned_m)) + velocity * (_brake_s(velocity, Limits()) / 2.0)


def _brake_s(velocity: Array, limits: Limits) -> float:
    """Return the duration of a smooth stop within the limit of acceleration."""
    return _SMOOTH_PEAK * float(np.linalg.norm(velocity)) / limits.acceleration_mps2


def transfer(
    start_ned_m: Vector,
    target_ned_m: Vector,
    start_heading_rad: float,
    target_heading_rad: float,
    limits: Limits = Limits(),
    *,
    start_velocity_ned_mps: Vector = (0.0, 0.0, 0.0),
    keeps_height: bool = False,
) -> Track:
    """Return the flight from a start (3,), NED, to rest at a target (3,), about as fast as the
    limits allow.

    The heading turns the shorter way: it ends at `target_heading_rad` plus the number of whole
    turns that is nearest to the start. If the start is too fast, or does not move towards the
    target, the vehicle first brakes to rest in the direction of its motion (the ground is not
    considered). A long transfer is straight, at constant speed between acceleration and braking.
    With `keeps_height`, a way flatter than 45 degrees is flown level at the greater of the two
    heights: the vehicle climbs before it, or descends after it. Raises ValueError if any argument
    is not finite.
    """
    start, target, velocity = (
        np.asarray(list(vector), dtype=np.float64)
        for vector in (start_ned_m, target_ned_m, start_velocity_ned_mps)
    )
    turn_rad = math.remainder(target_heading_rad - start_heading_rad, 2.0 * math.pi)
    begin, end = np.zeros((5, 4)), np.zeros((5, 4))
    begin[0] = *start, start_heading_rad
    begin[1, :3] = velocity
    end[0] = *target, start_heading_rad + turn_rad
    if not (np.all(np.isfinite(begin)) and np.all(np.isfinite(end))):
        raise ValueError("a transfer needs a finite start and a finite target")
    stops = _stops(begin, end) if keeps_height else [end]
    times_s, jets = [0.0], [begin]
    if velocity.any() and not _moves_well(begin, stops[0], limits):
        brake_s = max(_brake_s(velocity, limits), _BRAKE_MIN_S)
        times_s.append(brake_s)
        jets.append(_at_rest(begin[0] + begin[1] * (brake_s / 2.0)))
        stops = _stops(jets[-1], end) if keeps_height else [end]
    for stop in stops:
        for leg_s, jet in _legs(jets[-1], stop, limits):
            times_s.append(times_s[-1] + leg_s)
            jets.append(jet)
    return Track(joined(times_s, jets))


def _stops(begin: Array, end: Array) -> list[Array]:
    """Return where the vehicle stops on a level way: at `end`, and before it at a corner vertically
    above the lower of the two places, unless the straight way is steep or nearly level."""
    north_m, east_m, down_m = end[0, :3] - begin[0, :3]
    if abs(down_m) < _LEVEL_M or math.hypot(north_m, east_m) <= abs(down_m):
        return [end]
    lower, higher = (begin, end) if down_m < 0.0 else (end, begin)
    corner = _at_rest(lower[0])
    corner[0, 2] = higher[0, 2]
    return [corner, end]


def _legs(begin: Array, end: Array, limits: Limits) -> list[tuple[float, Array]]:
    """Return duration and end of each leg of a straight way to rest at `end`."""
    hop = _shortest(begin, end, limits)
    if hop.length_s <= _CRUISE_FROM_S:
        return [(hop.length_s, end)]
    return _cruise(begin[0], end[0], limits)


def _moves_well(begin: Array, end: Array, limits: Limits) -> bool:
    """Whether the start needs no braking: it is slow, or within the speed limit and towards the
    target, which one polynomial reaches."""
    velocity, way = begin[1, :3], end[0, :3] - begin[0, :3]
    speed_mps = float(np.linalg.norm(velocity))
    ahead = float(velocity @ way) >= _AHEAD * speed_mps * float(np.linalg.norm(way))
    fits = speed_mps <= _CREEP_MPS or (ahead and speed_mps <= limits.speed_mps)
    return fits and _shortest(begin, end, limits).length_s <= _CRUISE_FROM_S


def _at_rest(place: Array) -> Array:
    jet = np.zeros((5, 4))
    jet[0] = place
    return jet


def _shortest(begin: Array, end: Array, limits: Limits) -> Spline:
    """Return the shortest single polynomial within the limits, or one longer than _CRUISE_FROM_S,
    which may exceed them."""
    distance_m = float(np.linalg.norm(end[0, :3] - begin[0, :3]))
    turn_rad = abs(float(end[0, 3] - begin[0, 3]))
    # the mean speed and turn rate of a polynomial cannot exceed their limits
    duration_s = max(
        _DURATION_MIN_S, distance_m / limits.speed_mps, turn_rad / limits.heading_rate_radps
    )
    while True:
        candidate = joined([0.0, duration_s], [begin, end])
        if duration_s > _CRUISE_FROM_S or _excess(candidate, limits) <= 1.0:
            return candidate
        duration_s *= _GROWTH


def _cruise(start: Array, target: Array, limits: Limits) -> list[tuple[float, Array]]:
    """Return duration and end of three legs from rest to rest: acceleration, constant speed,
    braking. `start` and `target` (4,) are position and heading."""
    way = target - start
    speed_mps = _cruise_mps(way, limits)
    ramp_s = _SMOOTH_PEAK * speed_mps / limits.acceleration_mps2
    straight_s = _length_m(way) / speed_mps
    fast, slow = _at_rest(start), _at_rest(target)
    fast[1] = slow[1] = way / straight_s
    fast[0] += fast[1] * (ramp_s / 2.0)  # the mean speed of a ramp is half the final one
    slow[0] -= slow[1] * (ramp_s / 2.0)
    return [(ramp_s, fast), (straight_s - ramp_s, slow), (ramp_s, _at_rest(target))]


def _length_m(way: Array) -> float:
    return max(float(np.linalg.norm(way[:3])), 1e-6)


def _cruise_mps(way: Array, limits: Limits) -> float:
    """Return the constant speed on a way (4,) in position and heading; it is less on a short way,
    because of the share of acceleration and braking."""
    distance_m = _length_m(way)
    return min(
        max(limits.cruise_mps, limits.speed_mps),
        limits.cruise_vertical_mps * distance_m / max(abs(float(way[2])), 1e-6),
        limits.heading_rate_radps * distance_m / max(abs(float(way[3])), 1e-6),
        math.sqrt(_RAMPS_SHARE * distance_m * limits.acceleration_mps2 / _SMOOTH_PEAK),
    )


def _excess(curve: Spline, limits: Limits) -> float:
    """Return the largest ratio of a peak to its limit."""
    times_s = [np.linspace(*piece, 101) for piece in itertools.pairwise(curve.breaks_s)]
    jet = curve.jet(np.concatenate(times_s))
    return max(
        float(np.linalg.norm(jet[1, :, :3], axis=-1).max()) / limits.speed_mps,
        float(np.linalg.norm(jet[2, :, :3], axis=-1).max()) / limits.acceleration_mps2,
        float(np.abs(jet[1, :, 3]).max()) / limits.heading_rate_radps,
    )
