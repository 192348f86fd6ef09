"""The fastest smooth path through given points: the times at which it passes them.

The path between the points is the spline of `path.through`. SciPy's SLSQP minimises the sum of the
durations of its legs, with the constraint that thrust, tilt, tilt rate and speed stay within
limits. On each leg a limit is reached only at single times, not throughout: a path that is smooth
enough for an attitude loop is slower than a bang-bang one.
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
SAMPLES = 16  # per leg in the optimiser; the result is checked at four times as many
QUICKEST, SLOWEST = 1e-3, 1e4  # bounds of the first guess, times the durations at 1 m/s
POINTS_MOST = 40  # two seconds of search; the time grows with the square of this number


class PathLimits(Parameters):
    """Limits of the path, for a vehicle with this drag (linear, per unit of mass): speed, thrust
    per unit of mass, tilt, and the rate at which the thrust direction turns. The vehicle's own
    limits should be greater, so that feedback has a reserve."""

    speed_mps: float = Field(default=10.0, ge=0.1, le=30)
    thrust_mps2: float = Field(default=14.0, ge=10, le=100)  # just above g, paths last hours
    tilt_deg: float = Field(default=35.0, ge=1, le=80)
    tilt_rate_dps: float = Field(default=150.0, ge=5, le=1000)
    drag_per_mass_ps: float = Field(default=0.3, ge=0, le=2)


@lru_cache(maxsize=32)
def fastest_times(
    points_m: tuple[Triple, ...], smoothness: Smoothness, limits: PathLimits
) -> tuple[float, ...]:
    """Return the times (N,), s from 0, at which the fastest path passes the N `points_m`, [north,
    east, up] in m. Each leg takes whole milliseconds; the last digits depend on the computer.

    Raises ValueError like `path.through`, and if two neighbours coincide, if there are more than
    POINTS_MOST points, or if no durations keep the limits."""
    if len(points_m) > POINTS_MOST:
        raise ValueError(f"fastest takes at most {POINTS_MOST} points, not {len(points_m)}")
    points = np.array(points_m) * (1.0, 1.0, -1.0)
    legs_s = np.diff(times_from_speed(points, 1.0))

    def room(durations_s: Array, samples: int = SAMPLES) -> Array:
        path = through(points, np.append(0.0, np.cumsum(durations_s)), smoothness)
        return 1.0 - demands(path, limits, samples)

    def slowed(durations_s: Array) -> Array:
        """Return `durations_s` times the smallest common factor that keeps the limits."""

        def least(factor: float) -> float:
            return float(room(factor * durations_s, 4 * SAMPLES).min())

        return float(brentq(least, QUICKEST, SLOWEST, rtol=1e-6)) * durations_s

    try:
        start_s = slowed(legs_s)
    except ValueError:
        raise ValueError("no flight through these points keeps the limits of fastest") from None
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
    if np.isfinite(found.x).all():  # also without success the result may be better
        best_s = min((start_s, slowed(found.x * start_s)), key=np.sum)
    times_s = np.append(0.0, np.cumsum(np.ceil(1e3 * best_s))) / 1e3
    return tuple(times_s.tolist())


def demands(path: Spline, limits: PathLimits, samples: int) -> Array:
    """Return the greatest share (legs x 4,) of each limit that the path needs on each leg, among
    `samples` points of the leg."""
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
