"""Getting there: from a start, at rest or moving, to rest at a target; and references moved about.

Used for the climb after take-off and for flying to the start of a track.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BPoly, PPoly

from offboard.reference.base import FlatSample, Reference
from offboard.reference.path import Polynomial

Array = NDArray[np.float64]
Vector = Array | Iterable[float]

_DURATION_MIN_S = 0.5
_DURATION_MAX_S = 600.0
_GROWTH = 1.08
_CRUISE_FROM_S = 15.0  # a way that takes longer in one piece is flown in three
_RAMPS_SHARE = 0.6  # most of such a way that gaining and losing speed may take
_SMOOTH_PEAK = 35.0 / 16.0  # slope of the smoothstep of degree 7
_OVERSHOOT = 1.1  # a moving start may exceed the limits by its own speed; allow it this much more


@dataclass(frozen=True, slots=True)
class Limits:
    """How briskly a transfer may fly."""

    speed_mps: float = 1.5
    acceleration_mps2: float = 2.0
    course_rate_radps: float = 0.8
    # Of a way so long that it is flown at constant speed in between (MPC_XY_CRUISE and
    # MPC_Z_V_AUTO_DN of PX4 are 5 and 1.5 m/s)
    cruise_mps: float = 4.0
    cruise_vertical_mps: float = 1.5


@dataclass(frozen=True, slots=True)
class Transfer:
    """Polynomials of degree 9 in position and course; at rest, to snap, at their end.

    `polynomial` has the columns north, east, down (m) and course (rad). Before time 0 it rests
    at its start, after `duration_s` at its target.
    """

    polynomial: Polynomial

    @property
    def duration_s(self) -> float:
        return self.polynomial.length_s

    def sample(self, time_s: float | Array) -> FlatSample:
        """Flat outputs at `time_s`, a scalar or an array of any shape."""
        time = np.asarray(time_s, dtype=np.float64)
        flat = time.reshape(-1)
        jet = self.polynomial.jet(np.clip(flat, 0.0, self.duration_s))
        jet[1:, (flat < 0.0) | (flat > self.duration_s)] = 0.0
        jet = jet.reshape(5, *time.shape, 4)
        return FlatSample(*jet[:, ..., :3], *jet[:3, ..., 3])


def transfer(
    start_ned_m: Vector,
    target_ned_m: Vector,
    start_course_rad: float,
    target_course_rad: float,
    limits: Limits = Limits(),
    *,
    start_velocity_ned_mps: Vector = (0.0, 0.0, 0.0),
    start_acceleration_ned_mps2: Vector = (0.0, 0.0, 0.0),
) -> Transfer:
    """From a start (3,), NED, to rest at a target, as fast as the limits allow; turning the short
    way. The course ends at `target_course_rad` plus whole turns, next to the start's. A long way
    is flown straight, at constant speed between gaining and losing it.

    A moving start that breaks the limits by itself is allowed its own speed and acceleration. It
    overshoots in the direction it moves in: nothing here knows where the ground is.
    Raises ValueError for anything not finite.
    """
    start, target, velocity, acceleration = (
        np.asarray(list(vector), dtype=np.float64)
        for vector in (
            start_ned_m,
            target_ned_m,
            start_velocity_ned_mps,
            start_acceleration_ned_mps2,
        )
    )
    turn_rad = math.remainder(target_course_rad - start_course_rad, 2.0 * math.pi)
    begin, end = np.zeros((5, 4)), np.zeros((5, 4))
    begin[0] = *start, start_course_rad
    begin[1, :3], begin[2, :3] = velocity, acceleration
    end[0] = *target, start_course_rad + turn_rad
    if not (np.all(np.isfinite(begin)) and np.all(np.isfinite(end))):
        raise ValueError("a transfer needs a finite start and a finite target")
    allowed = replace(
        limits,
        speed_mps=max(limits.speed_mps, _OVERSHOOT * float(np.linalg.norm(velocity))),
        acceleration_mps2=max(
            limits.acceleration_mps2, _OVERSHOOT * float(np.linalg.norm(acceleration))
        ),
    )
    hop = Transfer(_shortest(begin, end, allowed))
    if hop.duration_s <= _CRUISE_FROM_S:
        return hop
    cruise = _cruising(begin, end, allowed)
    return hop if cruise is None else Transfer(cruise)


def _shortest(begin: Array, end: Array, limits: Limits) -> Polynomial:
    """The shortest polynomial within the limits, or the one that breaks them least."""
    distance_m = float(np.linalg.norm(end[0, :3] - begin[0, :3]))
    turn_rad = abs(float(end[0, 3] - begin[0, 3]))
    # no polynomial is faster than the mean speed or turn rate
    duration_s = max(
        _DURATION_MIN_S, distance_m / limits.speed_mps, turn_rad / limits.course_rate_radps
    )
    best, least = _polynomial(begin, end, duration_s), math.inf
    while duration_s < _DURATION_MAX_S:
        candidate = _polynomial(begin, end, duration_s)
        excess = _excess(candidate, limits)
        if excess < least:
            best, least = candidate, excess
        if excess <= 1.0:
            break
        duration_s *= _GROWTH
    return best


def _cruising(begin: Array, end: Array, limits: Limits) -> Polynomial | None:
    """Gain speed, keep it, lose it; None where the way is too short."""
    moving = begin[1]
    ramp_s = _SMOOTH_PEAK * _cruise_mps(end[0] - begin[0], limits) / limits.acceleration_mps2
    while True:
        # on average a ramp moves at the mean of the speeds at its ends
        way = end[0] - begin[0] - moving * (ramp_s / 2.0)
        speed_mps = _cruise_mps(way, limits)
        straight_s = _length_m(way) / speed_mps
        if straight_s <= ramp_s:
            return None
        slope = way / straight_s
        fast, slow = np.zeros((5, 4)), np.zeros((5, 4))
        fast[0], fast[1] = begin[0] + (moving + slope) * (ramp_s / 2.0), slope
        slow[0], slow[1] = end[0] - slope * (ramp_s / 2.0), slope
        times_s = np.cumsum([0.0, ramp_s, straight_s - ramp_s, ramp_s])
        candidate = _through(times_s, [begin, fast, slow, end])
        if _excess(candidate, replace(limits, speed_mps=speed_mps)) <= 1.0 + 1e-6:
            return candidate
        ramp_s *= _GROWTH  # a start that moves otherwise


def _length_m(way: Array) -> float:
    return max(float(np.linalg.norm(way[:3])), 1e-6)


def _cruise_mps(way: Array, limits: Limits) -> float:
    """Along a way (4,) in position and course; less where gaining speed would take most of it."""
    distance_m = _length_m(way)
    return min(
        max(limits.cruise_mps, limits.speed_mps),
        limits.cruise_vertical_mps * distance_m / max(abs(float(way[2])), 1e-6),
        limits.course_rate_radps * distance_m / max(abs(float(way[3])), 1e-6),
        math.sqrt(_RAMPS_SHARE * distance_m * limits.acceleration_mps2 / _SMOOTH_PEAK),
    )


def _polynomial(begin: Array, end: Array, duration_s: float) -> Polynomial:
    return _through([0.0, duration_s], [begin, end])


def _through(times_s: Array | list[float], jets: list[Array]) -> Polynomial:
    """Degree 9 from each (5, 4) jet, position to snap, to the next."""
    bernstein = BPoly.from_derivatives(times_s, jets)
    taylor = PPoly.from_bernstein_basis(bernstein).c[::-1].transpose(1, 0, 2)
    return Polynomial.from_taylor(bernstein.x, taylor)


def _excess(polynomial: Polynomial, limits: Limits) -> float:
    """The largest ratio of a peak to its limit."""
    times_s = [np.linspace(*piece, 101) for piece in itertools.pairwise(polynomial.breaks_s)]
    jet = polynomial.jet(np.concatenate(times_s))
    return max(
        float(np.linalg.norm(jet[1, :, :3], axis=-1).max()) / limits.speed_mps,
        float(np.linalg.norm(jet[2, :, :3], axis=-1).max()) / limits.acceleration_mps2,
        float(np.abs(jet[1, :, 3]).max()) / limits.course_rate_radps,
    )


@dataclass(frozen=True, slots=True)
class Hold:
    """Rest at a point (NED, m) with a course (rad), for `duration_s` and for ever after."""

    position_ned_m: tuple[float, float, float]
    course_rad: float
    duration_s: float = 0.0

    def sample(self, time_s: float | Array) -> FlatSample:
        """Flat outputs at `time_s`, a scalar or an array of any shape."""
        shape = np.shape(time_s)
        vectors = np.zeros((5, *shape, 3))
        vectors[0] = self.position_ned_m
        course = np.zeros((3, *shape))
        course[0] = self.course_rad
        return FlatSample(*vectors, *(derivative.reshape(shape) for derivative in course))


@dataclass(frozen=True, slots=True)
class Shifted:
    """A reference that begins at `start_s` of another time axis (vehicle time, say)."""

    reference: Reference
    start_s: float

    @property
    def duration_s(self) -> float:
        """The end, on the new axis."""
        return self.start_s + self.reference.duration_s

    def sample(self, time_s: float | Array) -> FlatSample:
        """Flat outputs at `time_s` of the new axis, a scalar or an array of any shape."""
        return self.reference.sample(np.asarray(time_s, dtype=np.float64) - self.start_s)


@dataclass(frozen=True, slots=True)
class Placed:
    """A reference given relative to a point, placed there: NED, m (the take-off point, say)."""

    reference: Reference
    origin_ned_m: tuple[float, float, float]

    @property
    def duration_s(self) -> float:
        return self.reference.duration_s

    def sample(self, time_s: float | Array) -> FlatSample:
        """Flat outputs at `time_s`, a scalar or an array of any shape."""
        sample = self.reference.sample(time_s)
        return replace(sample, position_ned_m=sample.position_ned_m + np.array(self.origin_ned_m))
