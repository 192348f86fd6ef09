"""Starting and stopping smoothly on a path: a warp of time, and the chain rule through it.

The path's time s(t) starts at rest, runs at rate 1 and comes to rest again. Compiled, because a
controller samples its reference several times per decision.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@numba.njit(cache=True)
def warp(time_s: Array, run_in_s: float, cruise_s: float, run_out_s: float) -> Array:
    """s(t) and its first four derivatives, shape (5, N), for t of shape (N,).

    ds/dt rises from 0 to 1 within `run_in_s`, stays for `cruise_s`, falls to 0 within
    `run_out_s`, along the smoothstep of degree 9: four derivatives of ds/dt vanish at every
    joint. A run of duration R covers R / 2 of the path. Outside, s rests at its ends.
    """
    out = np.zeros((5, time_s.size))
    end_s = run_in_s + cruise_s + run_out_s
    length_s = 0.5 * run_in_s + cruise_s + 0.5 * run_out_s
    for i in range(time_s.size):
        t = time_s[i]
        if t < 0.0:
            out[0, i] = 0.0
        elif t < run_in_s:
            ramp(t / run_in_s, run_in_s, 1.0, out[:, i])
        elif t <= run_in_s + cruise_s:
            out[0, i] = t - 0.5 * run_in_s
            out[1, i] = 1.0
        elif t < end_s:
            ramp((end_s - t) / run_out_s, run_out_s, -1.0, out[:, i])
            out[0, i] += length_s
        else:
            out[0, i] = length_s
    return out


@numba.njit(cache=True)
def ramp(x: float, duration_s: float, direction: float, out: Array) -> None:
    """The smoothstep of degree 9 at x in [0, 1], as s and four derivatives by time, into out (5,).

    direction -1 runs backwards in time: s and its even derivatives change sign.
    """
    u = x * (1.0 - x)
    out[0] = (
        direction * duration_s * x**6 * (21.0 + x * (-60.0 + x * (67.5 + x * (-35.0 + 7.0 * x))))
    )
    out[1] = x**5 * (126.0 + x * (-420.0 + x * (540.0 + x * (-315.0 + 70.0 * x))))
    out[2] = direction * 630.0 * u**4 / duration_s
    out[3] = 2520.0 * u**3 * (1.0 - 2.0 * x) / duration_s**2
    out[4] = direction * 2520.0 * u**2 * (3.0 - 14.0 * u) / duration_s**3


@numba.njit(cache=True)
def compose_position(s: Array, path: Array) -> Array:
    """Derivatives by time (5, N, 3) of a path (5, N, 3) travelled as s (5, N) (Faa di Bruno)."""
    out = np.empty_like(path)
    for i in range(s.shape[1]):
        s1, s2, s3, s4 = s[1, i], s[2, i], s[3, i], s[4, i]
        for axis in range(path.shape[2]):
            p1, p2, p3, p4 = path[1, i, axis], path[2, i, axis], path[3, i, axis], path[4, i, axis]
            out[0, i, axis] = path[0, i, axis]
            out[1, i, axis] = p1 * s1
            out[2, i, axis] = p2 * s1**2 + p1 * s2
            out[3, i, axis] = p3 * s1**3 + 3.0 * p2 * s1 * s2 + p1 * s3
            out[4, i, axis] = (
                p4 * s1**4 + 6.0 * p3 * s1**2 * s2 + p2 * (3.0 * s2**2 + 4.0 * s1 * s3) + p1 * s4
            )
    return out


@numba.njit(cache=True)
def compose_course(s: Array, course: Array) -> Array:
    """Course, rate and acceleration by time (3, N) of a course (3, N) travelled as s (5, N)."""
    out = np.empty_like(course)
    for i in range(s.shape[1]):
        out[0, i] = course[0, i]
        out[1, i] = course[1, i] * s[1, i]
        out[2, i] = course[2, i] * s[1, i] ** 2 + course[1, i] * s[2, i]
    return out
