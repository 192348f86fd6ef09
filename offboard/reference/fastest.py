"""The fastest smooth path through given points: the times at which it passes them.

The path between the points is the spline of `path.through`; SLSQP of SciPy chooses the durations of
its legs with the least sum for which thrust, tilt, its rate and speed stay within limits. Where the
limits bind on a leg they bind at a moment, not throughout: a path that is as smooth as an attitude
loop can follow is slower than a bang-bang one.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.optimize import brentq, minimize

from offboard.documents.parameters import Parameters
from offboard.reference.base import FlatSample
from offboard.reference.flatness import flat_state
from offboard.reference.path import Smoothness, Spline, Triple, through, times_from_speed

Array = NDArray[np.float64]

GRAVITY_MPS2 = 9.80665
SAMPLES = 16  # a leg; of the optimiser, and four times as many of the result
QUICKEST, SLOWEST = 1e-3, 1e4  # times the durations at 1 m/s: bounds of the first guess
POINTS_MOST = 40  # two seconds of search, which grow with the square of this number


class PathLimits(Parameters):
    """What the path may ask for, of a vehicle with this drag (linear, per unit of mass): speed,
    thrust per unit of mass, tilt, and how fast the thrust direction turns. What the vehicle has
    beyond them is left to feedback."""

    speed_mps: float = Field(default=10.0, ge=0.1, le=30)
    thrust_mps2: float = Field(default=14.0, ge=10, le=100)  # just above g a path takes hours
    tilt_deg: float = Field(default=35.0, ge=1, le=80)
    tilt_rate_dps: float = Field(default=150.0, ge=5, le=1000)
    drag_per_mass_ps: float = Field(default=0.3, ge=0, le=2)


@lru_cache(maxsize=32)
def fastest_times(
    points_m: tuple[Triple, ...], smoothness: Smoothness, limits: PathLimits
) -> tuple[float, ...]:
    """Times (N,), s from 0, at which the fastest path passes `points_m`, N of [north, east, up] in
    m. Each leg takes whole milliseconds; the last ones depend on the computer.

    Raises ValueError like `path.through`, where two neighbours coincide, for more than POINTS_MOST
    points, and where no durations keep the limits."""
    if len(points_m) > POINTS_MOST:
        raise ValueError(f"fastest takes at most {POINTS_MOST} points, not {len(points_m)}")
    points = np.array(points_m) * (1.0, 1.0, -1.0)
    legs_s = np.diff(times_from_speed(points, 1.0))

    def room(durations_s: Array, samples: int = SAMPLES) -> Array:
        path = through(points, np.append(0.0, np.cumsum(durations_s)), smoothness)
        return 1.0 - demands(path, limits, samples)

    def slowed(durations_s: Array) -> Array:
        """The same path, as fast as a common factor of its durations allows."""

        def least(factor: float) -> float:
            return float(room(factor * durations_s, 4 * SAMPLES).min())

        return float(brentq(least, QUICKEST, SLOWEST, rtol=1e-6)) * durations_s

    try:
        start_s = slowed(legs_s)
    except ValueError:
        raise ValueError("no times of these points keep the limits of fastest") from None
    found = minimize(
        lambda scale: scale @ start_s / start_s.sum(),
        np.ones(len(start_s)),
        jac=lambda scale: start_s / start_s.sum(),
        bounds=[(0.2, 5.0)] * len(start_s),
        constraints={"type": "ineq", "fun": lambda scale: room(scale * start_s)},
        method="SLSQP",
        options={"maxiter": 200, "ftol": 1e-5},
    )
    best_s = start_s
    if np.isfinite(found.x).all():  # without success it may still be better
        best_s = min((start_s, slowed(found.x * start_s)), key=np.sum)
    times_s = np.append(0.0, np.cumsum(np.ceil(1e3 * best_s))) / 1e3
    return tuple(times_s.tolist())


def demands(path: Spline, limits: PathLimits, samples: int) -> Array:
    """The greatest share (legs x 4,) of each limit that the path needs on each leg, at `samples`
    places of a leg."""
    breaks_s = path.breaks_s
    shares = np.linspace(0.0, 1.0, samples)
    s = (breaks_s[:-1, None] + np.diff(breaks_s)[:, None] * shares).ravel()
    sample = FlatSample(*path.jet(s), *np.zeros((3, s.size)))
    flat = flat_state(sample, GRAVITY_MPS2, limits.drag_per_mass_ps)
    tilt_rad = np.arccos(np.clip(flat.thrust_direction_ned[:, 2], -1.0, 1.0))
    needed = np.stack(
        (
            np.linalg.norm(sample.velocity_ned_mps, axis=1) / limits.speed_mps,
            flat.thrust_mps2 / limits.thrust_mps2,
            tilt_rad / np.radians(limits.tilt_deg),
            np.linalg.norm(flat.thrust_direction_rate_ned_ps, axis=1)
            / np.radians(limits.tilt_rate_dps),
        )
    )
    worst: Array = needed.reshape(4, -1, samples).max(axis=2).ravel()
    return worst
