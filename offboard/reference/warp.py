"""Smooth starts and stops on a path: the path's time s(t), and the chain rule for its derivatives.

s(t) starts at rest, runs at rate 1 and comes to rest again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def warp(time_s: Array, run_in_s: float, cruise_s: float, run_out_s: float) -> Array:
    """s(t) and its first four derivatives, shape (5, N), for t of shape (N,).

    ds/dt rises from 0 to 1 within `run_in_s`, stays for `cruise_s`, falls to 0 within
    `run_out_s`, along the smoothstep of degree 9: four derivatives of ds/dt vanish at every
    joint. A run of duration R covers R / 2 of the path. Outside, s rests at its ends.
    """
    out = np.zeros((5, time_s.size))
    cruise_end_s = run_in_s + cruise_s
    end_s = cruise_end_s + run_out_s
    length_s = 0.5 * run_in_s + cruise_s + 0.5 * run_out_s
    starts = (time_s >= 0.0) & (time_s < run_in_s)
    cruises = (time_s >= run_in_s) & (time_s <= cruise_end_s)
    stops = (time_s > cruise_end_s) & (time_s < end_s)
    out[:, starts] = _ramp(time_s[starts] / run_in_s, run_in_s, 1.0)
    out[0, cruises] = time_s[cruises] - 0.5 * run_in_s
    out[1, cruises] = 1.0
    out[:, stops] = _ramp((end_s - time_s[stops]) / run_out_s, run_out_s, -1.0)
    out[0, time_s > cruise_end_s] += length_s
    return out


def _ramp(x: Array, duration_s: float, direction: float) -> Array:
    """The smoothstep of degree 9 at x (N,) in [0, 1]: s and four derivatives by time (5, N).

    direction -1 runs backwards in time: s and its even derivatives change sign.
    """
    u = x * (1.0 - x)
    shape = 21.0 + x * (-60.0 + x * (67.5 + x * (-35.0 + 7.0 * x)))
    slope = 126.0 + x * (-420.0 + x * (540.0 + x * (-315.0 + 70.0 * x)))
    return np.array(
        [
            direction * duration_s * x**6 * shape,
            x**5 * slope,
            direction * 630.0 * u**4 / duration_s,
            2520.0 * u**3 * (1.0 - 2.0 * x) / duration_s**2,
            direction * 2520.0 * u**2 * (3.0 - 14.0 * u) / duration_s**3,
        ]
    )


def compose_position(s: Array, path: Array) -> Array:
    """Derivatives by time (5, N, 3) of a path (5, N, 3) at s(t) (5, N) (Faa di Bruno)."""
    s1, s2, s3, s4 = s[1:, :, np.newaxis]
    p0, p1, p2, p3, p4 = path
    return np.array(
        [
            p0,
            p1 * s1,
            p2 * s1**2 + p1 * s2,
            p3 * s1**3 + 3.0 * p2 * s1 * s2 + p1 * s3,
            p4 * s1**4 + 6.0 * p3 * s1**2 * s2 + p2 * (3.0 * s2**2 + 4.0 * s1 * s3) + p1 * s4,
        ]
    )


def compose_heading(s: Array, heading: Array) -> Array:
    """Heading, rate and acceleration by time (3, N) of a heading (3, N) at s(t) (5, N)."""
    c0, c1, c2 = heading
    return np.array([c0, c1 * s[1], c2 * s[1] ** 2 + c1 * s[2]])
