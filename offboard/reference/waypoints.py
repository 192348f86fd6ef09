"""Smooth paths through points: minimum snap or minimum jerk, from rest to rest.

With clamped ends the minimiser of the integral of the squared m-th derivative through given
points at given times is the interpolating spline of degree 2 m - 1: no QP is needed.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from offboard.reference.path import Polynomial

Array = NDArray[np.float64]

_REST_LEG_STRETCH = 1.5  # the first and the last leg start or end at rest and need more time


class Smoothness(StrEnum):
    """The derivative whose square is minimised. Inside, `jerk` gives a path continuous to snap,
    `snap` one continuous to two derivatives more.

    At the ends velocity and acceleration vanish, with `snap` jerk too; the run-in and run-out of
    `Track` make the higher derivatives continuous there."""

    JERK = "jerk"
    SNAP = "snap"


_ORDER = {Smoothness.JERK: 3, Smoothness.SNAP: 4}


def times_from_speed(points_ned_m: Array, speed_mps: float) -> Array:
    """Arrival times (N,), from 0: `speed_mps` is the mean speed of an inner leg; the first and
    the last leg take 1.5 times as long. Raises ValueError when two neighbours coincide."""
    legs_m = np.linalg.norm(np.diff(points_ned_m, axis=0), axis=1)
    for index, leg_m in enumerate(legs_m):
        if leg_m < 1e-3:
            raise ValueError(f"points {index + 1} and {index + 2} are the same place")
    legs_s = legs_m / speed_mps
    legs_s[0] *= _REST_LEG_STRETCH
    if len(legs_s) > 1:
        legs_s[-1] *= _REST_LEG_STRETCH
    return np.concatenate([[0.0], np.cumsum(legs_s)])


def through(points_ned_m: Array, times_s: Array, smoothness: Smoothness) -> Polynomial:
    """The minimum-jerk or minimum-snap path through points (N, 3) at times (N,), N >= 2.

    Raises ValueError unless the times are finite, start at 0 and increase."""
    if len(points_ned_m) < 2:
        raise ValueError(f"a path needs at least 2 points, not {len(points_ned_m)}")
    if len(times_s) != len(points_ned_m):
        raise ValueError(f"{len(points_ned_m)} points need as many times, not {len(times_s)}")
    if not np.all(np.isfinite(points_ned_m)) or not np.all(np.isfinite(times_s)):
        raise ValueError("points and times must be finite")
    if times_s[0] != 0.0 or np.any(np.diff(times_s) <= 0.0):
        raise ValueError("the times of the points must start at 0 and increase")
    order = _ORDER[smoothness]
    rest = [(derivative, np.zeros(3)) for derivative in range(1, order)]
    spline = make_interp_spline(times_s, points_ned_m, k=2 * order - 1, bc_type=(rest, rest))
    return Polynomial.from_spline(spline)
