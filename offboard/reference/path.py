"""Geometric paths, and the heading along their velocity.

A path maps its own time s (seconds at full speed) to a position and its derivatives with respect to
s. Paths are `Harmonic`, or a `Spline` of SciPy through points. `track` adds starting and stopping.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BPoly, BSpline, PPoly, make_interp_spline, make_lsq_spline

Array = NDArray[np.float64]
Triple = tuple[float, float, float]

ORDERS = 5  # position, velocity, acceleration, jerk, snap
HEADING = 3  # column of a jet, after north, east and down
HOLD_SPEED_MPS = 0.1  # below this speed the direction of the velocity is not used as a heading
_ORDER = np.arange(ORDERS, dtype=np.float64)[:, np.newaxis, np.newaxis]
_ZERO: Triple = (0.0, 0.0, 0.0)
_DEGREE = 5  # degree of a spline through the rows of a table
_REST_LEG_STRETCH = 1.5  # the first and the last leg start or end at rest and need more time
_STEP_S, _NODES_MAX = 0.02, 200_000  # spacing and number of nodes that unwrap a path's direction


class Path(Protocol):
    """Position along a path and its first four derivatives, computed analytically.

    `length_s` is the time that the path takes at full speed. A `bounded` path is defined on
    [0, length_s] only; others continue smoothly beyond both ends (laps of a closed curve).
    """

    @property
    def length_s(self) -> float: ...

    @property
    def bounded(self) -> bool: ...

    def jet(self, path_time_s: Array) -> Array:
        """Return derivatives 0 to 4 with respect to s, NED and SI, for s of shape (N,): (5, N, 3),
        or (5, N, 4) with the heading, rad, as a fourth column."""
        ...


@dataclass(frozen=True, slots=True)
class Sine:
    """amplitude_i sin(omega_i s + phase_i), i = north, east, down. SI."""

    amplitude_ned_m: Triple
    omega_ned_radps: Triple
    phase_ned_rad: Triple = _ZERO


@dataclass(frozen=True, slots=True)
class Harmonic:
    """p(s) = offset + slope s + the sum of `sines`, with all derivatives in closed form: lines,
    circles, helices, Lissajous figures. SI."""

    length_s: float
    bounded: bool = False
    offset_ned_m: Triple = _ZERO
    slope_ned_mps: Triple = _ZERO
    sines: tuple[Sine, ...] = ()

    def jet(self, path_time_s: Array) -> Array:
        """See `Path`."""
        time = path_time_s[:, np.newaxis]
        slope = np.array(self.slope_ned_mps)
        result: Array = np.zeros((ORDERS, path_time_s.size, 3))
        result[0] = np.array(self.offset_ned_m) + slope * time
        result[1] = slope
        for sine in self.sines:
            omega = np.array(sine.omega_ned_radps)
            angle = omega * time + np.array(sine.phase_ned_rad)
            # d/ds of sin(omega s + phase) adds a quarter turn and a factor omega
            scale = np.array(sine.amplitude_ned_m) * omega**_ORDER
            result += scale * np.sin(angle + 0.5 * math.pi * _ORDER)
        return result


class Spline:
    """A piecewise polynomial of SciPy that begins at s = 0, with its derivatives."""

    bounded = True

    def __init__(self, curve: BSpline | PPoly) -> None:
        if isinstance(curve, BSpline):
            starts = np.unique(curve.t)
            powers = range(curve.k, -1, -1)
            factors = [curve(starts[:-1], nu=power) / math.factorial(power) for power in powers]
            curve = PPoly(np.array(factors), starts)
        self.breaks_s: Array = curve.x
        self.length_s = float(curve.x[-1])
        # all derivatives as columns of one polynomial, because five calls would take 0.1 ms
        together = np.zeros((*curve.c.shape[:2], ORDERS, curve.c.shape[2]))
        for order in range(ORDERS):
            factors = curve.derivative(order).c
            together[len(together) - len(factors) :, :, order] = factors
        self._curves = PPoly(together, curve.x)

    def jet(self, path_time_s: Array) -> Array:
        """Return derivatives 0 to 4, (5, N, columns), for s of shape (N,)."""
        jet: Array = self._curves(path_time_s).transpose(1, 0, 2)
        return jet


def joined(times_s: Array | list[float], jets: Array | list[Array]) -> Spline:
    """Return the polynomials that join each jet (derivatives, columns) to the next one, with all
    derivatives of both."""
    return Spline(PPoly.from_bernstein_basis(BPoly.from_derivatives(times_s, jets)))


class Smoothness(StrEnum):
    """The derivative whose square is minimised. Between its ends the path is continuous to snap
    with `jerk`, and to two more derivatives with `snap`.

    At the ends velocity and acceleration are zero, with `snap` jerk too; the run-in and run-out of
    `Track` make the higher derivatives continuous there."""

    JERK = "jerk"
    SNAP = "snap"


def times_from_speed(points_ned_m: Array, speed_mps: float) -> Array:
    """Return the arrival times (N,), from 0, for a mean speed `speed_mps` of inner legs; the first
    and the last leg take 1.5 times as long. Raises ValueError if two neighbours coincide."""
    legs_m = np.linalg.norm(np.diff(points_ned_m, axis=0), axis=1)
    for index, leg_m in enumerate(legs_m):
        if leg_m < 1e-3:
            raise ValueError(f"points {index + 1} and {index + 2} are at the same place")
    legs_s = legs_m / speed_mps
    legs_s[0] *= _REST_LEG_STRETCH
    if len(legs_s) > 1:
        legs_s[-1] *= _REST_LEG_STRETCH
    return np.concatenate([[0.0], np.cumsum(legs_s)])


def through(points_ned_m: Array, times_s: Array, smoothness: Smoothness) -> Spline:
    """Return the minimum-jerk or minimum-snap path from rest to rest through points (N, 3) at times
    (N,), N >= 2: the interpolating spline of degree 2 m - 1 with clamped ends minimises the
    integral of the squared m-th derivative.

    Raises ValueError unless there are as many times as points, which start at 0 and increase."""
    if len(times_s) != len(points_ned_m):
        raise ValueError(f"{len(points_ned_m)} points need as many times, not {len(times_s)}")
    if times_s[0] != 0.0 or np.any(np.diff(times_s) <= 0.0):
        raise ValueError("the times of the points must start at 0 and increase")
    order = 3 if smoothness is Smoothness.JERK else 4
    rest = [(derivative, np.zeros(3)) for derivative in range(1, order)]
    return Spline(make_interp_spline(times_s, points_ned_m, k=2 * order - 1, bc_type=(rest, rest)))


def interpolate(times_s: Array, values: Array, knot_spacing_s: float = 0.0) -> Spline:
    """Return a quintic spline, continuous to its fourth derivative, through values (N, C) at times
    (N,).

    It minimises the integral of the squared jerk; third and fourth derivative are zero at the ends.
    With a positive `knot_spacing_s` it is a least-squares fit with knots at least so far apart, for
    rounded or noisy values.
    """
    rows = times_s.size
    intervals = int(times_s[-1] / knot_spacing_s) if knot_spacing_s > 0.0 else rows
    if intervals + _DEGREE >= rows:  # a fit would not have fewer coefficients than rows
        natural = [(order, np.zeros(values.shape[1:])) for order in (3, 4)]
        return Spline(make_interp_spline(times_s, values, k=_DEGREE, bc_type=(natural, natural)))
    # knots at rows, with equal numbers of rows between, so that each span has data
    # (Schoenberg-Whitney)
    knots = times_s[np.rint(np.linspace(0, rows - 1, intervals + 1)).astype(np.int64)]
    return Spline(make_lsq_spline(times_s, values, np.pad(knots, _DEGREE, "edge"), k=_DEGREE))


class AlongVelocity:
    """Heading along the horizontal velocity, unwrapped from the start of the path, for s in
    [0, length_s]. On a path that never moves horizontally the heading is `standstill_rad`.

    The derivative of position with respect to s has the direction of the velocity, so that a start
    from rest needs no special case. Only where the path itself is slower than `HOLD_SPEED_MPS` is
    the direction replaced by a quintic polynomial. It continues heading, rate and acceleration at
    both ends of that interval, turns the shorter way, and is at rest at the path's own ends.
    """

    def __init__(self, path: Path, length_s: float, standstill_rad: float = 0.0) -> None:
        count = int(np.clip(np.ceil(length_s / _STEP_S), 50, _NODES_MAX)) + 1
        nodes_s = np.linspace(0.0, length_s, count)
        path_jet = path.jet(nodes_s)
        fast = np.hypot(path_jet[1, :, 0], path_jet[1, :, 1]) >= HOLD_SPEED_MPS
        jet = direction_jet(path_jet)
        places = np.flatnonzero(fast)
        if places.size:
            # a slow node gets the heading of the next fast one, so that unwrapping crosses it
            following = np.minimum(np.searchsorted(places, np.arange(count)), places.size - 1)
            jet[0] = np.unwrap(jet[0, places[following]])
        else:
            jet[0] = standstill_rad
        # they determine the number of whole turns of a direction
        self._step_s, self._nodes_rad = float(nodes_s[1]), jet[0].copy()
        jet[1:, ~fast] = 0.0  # used if the path begins or ends slowly
        change = np.flatnonzero(np.diff(fast))
        edges = np.unique(np.concatenate(([0], change + ~fast[change], [count - 1])))
        self._slow = ~(fast[edges[:-1]] & fast[edges[:-1] + 1])
        self._edges_s = nodes_s[edges]
        self._across = joined(self._edges_s, jet[:, edges].T[:, :, np.newaxis])

    def jet(self, path_time_s: Array, path_jet: Array) -> Array:
        """Return the heading (unwrapped) and its first two derivatives with respect to s, (3, N),
        rad and s. `path_jet` (5, N, 3) is the path at `path_time_s` (N,)."""
        jet = direction_jet(path_jet)
        node = np.rint(path_time_s / self._step_s).astype(np.intp)
        nearest_rad = self._nodes_rad[np.clip(node, 0, self._nodes_rad.size - 1)]
        jet[0] += 2.0 * np.pi * np.rint((nearest_rad - jet[0]) / (2.0 * np.pi))
        piece = np.searchsorted(self._edges_s[1:-1], path_time_s)
        slow = self._slow[piece]
        if slow.any():
            jet[:, slow] = self._across.jet(path_time_s[slow])[:3, :, 0]
        return jet


def direction_jet(path_jet: Array) -> Array:
    """Return the direction of the horizontal velocity in (-pi, pi], its rate and acceleration,
    (3, N), from path_jet (5, N, 3). The result is finite at any speed: the squared speed is at
    least 1e-6 m^2/s^2.
    """
    (vn, ve), (an, ae), (jn, je) = path_jet[1:4, :, :2].transpose(0, 2, 1)
    square = np.maximum(vn * vn + ve * ve, 1e-6)
    rate = (vn * ae - ve * an) / square
    # math.atan2, because the last digit of numpy's arctan2 depends on the processor
    direction = list(map(math.atan2, ve.tolist(), vn.tolist()))
    acceleration = (vn * je - ve * jn - 2.0 * rate * (vn * an + ve * ae)) / square
    return np.array((direction, rate, acceleration))
