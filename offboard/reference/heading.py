"""Where the nose points along a path: fixed, given by a table, or along the horizontal velocity.

A heading is a function of the path's time s, like the path itself. The derivative of position by s
has the direction of the velocity, so that a start from rest needs no special case. Only where the
path itself is slower than `HOLD_SPEED_MPS` the direction is interpolated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BPoly, PPoly

from offboard.reference.path import Path, Polynomial

Array = NDArray[np.float64]

HOLD_SPEED_MPS = 0.1
_STEP_S = 0.02
_NODES_MAX = 200_000


class Heading(Protocol):
    """Where the nose points along a path."""

    def jet(self, path_time_s: Array, path_jet: Array) -> Array:
        """Heading (unwrapped), its first and second derivative by s, shape (3, N), rad and s.

        path_time_s (N,); path_jet (5, N, 3) is the path at the same times."""
        ...


@dataclass(frozen=True, slots=True)
class Fixed:
    """A constant heading."""

    heading_rad: float

    def jet(self, path_time_s: Array, path_jet: Array) -> Array:
        result = np.zeros((3, path_time_s.size))
        result[0] = self.heading_rad
        return result


@dataclass(frozen=True, slots=True)
class Tabulated:
    """The heading column of a table: a polynomial with one column, in radians."""

    polynomial: Polynomial

    def jet(self, path_time_s: Array, path_jet: Array) -> Array:
        return np.ascontiguousarray(self.polynomial.jet(path_time_s)[:3, :, 0])


@dataclass(frozen=True, slots=True)
class AlongVelocity:
    """The direction of the horizontal velocity, unwrapped from the start of the path.

    nodes_rad (K,): the unwrapped heading every `step_s` from s = 0; it tells how many whole turns
    are added to a direction. slow_s (M, 2): intervals in which the horizontal speed is below
    `HOLD_SPEED_MPS`. There the direction is replaced by a quintic, slow_coefficients (M, 6) in
    powers of s - slow_s[:, 0], which continues heading, rate and acceleration at both ends of the
    interval, turns the short way, and comes to rest where the path begins or ends.
    """

    step_s: float
    nodes_rad: Array
    slow_s: Array
    slow_coefficients: Array

    def jet(self, path_time_s: Array, path_jet: Array) -> Array:
        jet = direction_jet(path_jet)
        node = np.rint(path_time_s / self.step_s).astype(np.intp)
        nearest_rad = self.nodes_rad[np.clip(node, 0, self.nodes_rad.size - 1)]
        jet[0] += 2.0 * np.pi * np.rint((nearest_rad - jet[0]) / (2.0 * np.pi))
        if len(self.slow_s):
            # the first interval that does not end before
            interval = np.searchsorted(self.slow_s[:-1, 1], path_time_s)
            begin_s, end_s = self.slow_s[interval].T
            slow = (begin_s <= path_time_s) & (path_time_s <= end_s)
            if slow.any():
                coefficients = self.slow_coefficients[interval[slow]].T
                jet[:, slow] = _quintic((path_time_s - begin_s)[slow], coefficients)
        return jet


def along_velocity(path: Path, length_s: float, standstill_rad: float = 0.0) -> Heading:
    """The heading along the horizontal velocity of a path, for s in [0, length_s].

    A path that never moves horizontally has the fixed heading `standstill_rad`.
    """
    count = int(np.clip(np.ceil(length_s / _STEP_S), 50, _NODES_MAX)) + 1
    nodes_s = np.linspace(0.0, length_s, count)
    path_jet = path.jet(nodes_s)
    fast = np.hypot(path_jet[1, :, 0], path_jet[1, :, 1]) >= HOLD_SPEED_MPS
    if not fast.any():
        return Fixed(standstill_rad)
    direction = direction_jet(path_jet)
    held = direction[0].copy()
    # a slow node takes the heading of the next fast one, so that unwrapping works across it
    fast_index = np.flatnonzero(fast)
    nearest = fast_index[
        np.clip(np.searchsorted(fast_index, np.arange(count)), 0, fast_index.size - 1)
    ]
    direction[0] = np.unwrap(held[nearest])
    slow_s, coefficients = _slow_intervals(nodes_s, direction, fast)
    return AlongVelocity(float(nodes_s[1]), direction[0], slow_s, coefficients)


def _slow_intervals(
    nodes_s: Array, direction: Array, fast: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Intervals (M, 2) and quintics (M, 6) over the runs of slow nodes; direction (3, K)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[True], fast, [True]]).astype(np.int8)))
    last = fast.size - 1
    intervals: list[tuple[float, float]] = []
    coefficients: list[Array] = []
    for first_slow, first_fast in zip(edges[::2], edges[1::2], strict=True):
        left, right = max(first_slow - 1, 0), min(first_fast, last)
        start = direction[:, left] if fast[left] else np.array([direction[0, right], 0.0, 0.0])
        end = direction[:, right] if fast[right] else np.array([direction[0, left], 0.0, 0.0])
        ends = (float(nodes_s[left]), float(nodes_s[right]))
        quintic = PPoly.from_bernstein_basis(BPoly.from_derivatives(ends, [start, end]))
        intervals.append(ends)
        coefficients.append(quintic.c[::-1, 0])
    return np.reshape(intervals, (-1, 2)).astype(np.float64), np.reshape(coefficients, (-1, 6))


def direction_jet(path_jet: Array) -> Array:
    """Direction of the horizontal velocity in (-pi, pi], its rate and acceleration: (3, N).

    path_jet (5, N, 3). Finite at any speed: the squared speed is floored at 1e-6 m^2/s^2.
    """
    (vn, ve), (an, ae), (jn, je) = path_jet[1:4, :, :2].transpose(0, 2, 1)
    square = np.maximum(vn * vn + ve * ve, 1e-6)
    rate = (vn * ae - ve * an) / square
    # numpy's arctan2 differs in the last digit from one processor to another
    direction = list(map(math.atan2, ve.tolist(), vn.tolist()))
    acceleration = (vn * je - ve * jn - 2.0 * rate * (vn * an + ve * ae)) / square
    return np.array((direction, rate, acceleration))


def _quintic(x: Array, c: Array) -> Array:
    """Value, first and second derivative (3, N) at x (N,) of polynomials with coefficients
    c (6, N)."""
    return np.array(
        (
            c[0] + x * (c[1] + x * (c[2] + x * (c[3] + x * (c[4] + x * c[5])))),
            c[1] + x * (2.0 * c[2] + x * (3.0 * c[3] + x * (4.0 * c[4] + x * 5.0 * c[5]))),
            2.0 * c[2] + x * (6.0 * c[3] + x * (12.0 * c[4] + x * 20.0 * c[5])),
        )
    )
