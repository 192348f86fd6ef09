"""Drag, hover thrust and thrust lag from positions, attitudes and the thrust commanded.

Reported velocity is not used: on PX4 it is not the derivative of the reported position. Instead a
Kalman filter per axis follows the position under the acceleration that attitude and thrust must
have given, allowing for an estimator that wanders and for a disturbance that drifts; what it could
not foresee, its innovations, is white for the right constants, and least squares on it finds them
(maximum likelihood; L. Ljung, System Identification, 1999, 7.4). Knows arrays and no flight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from offboard.control.response_fit import Estimate, thinned
from offboard.control.trace import (
    NORTH,
    POSITION,
    SENT_AT,
    SENT_THRUST,
    STAMP,
    Trace,
)
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]

# What is allowed for, per root second: a position that wanders (PX4: .013-.030 m), an acceleration
# that is not modelled (m/s), a disturbance that drifts (m/s^2; PX4's tilt error times g is .1).
POSITION_DENSITY, ACCELERATION_DENSITY, DISTURBANCE_DENSITY = 0.05, 0.1, 0.08
# The vertical has no disturbance beside the hover thrust sought.
VERTICAL_DRIFT = 0.03
POSITION_SD_M = 0.001
START_SPEED_SD_MPS, START_DISTURBANCE_SD_MPS2 = 3.0, 0.5
# Innovations of a wandering estimator stay related for this long.
RELATED_S = 2.0
STEPS_S = 0.018  # closer positions are thinned: nothing is learnt from them

DRAG_START, DRAG_UPPER = 0.6, 5.0
# Least values to search from: without a lag thrust jumps between samples and has no slope.
SEARCHED_FROM = (0.005, 0.03, 0.01)
LAG_UPPER_S, THRUST_DELAY_UPPER_S = 0.4, 0.5


@dataclass(frozen=True, slots=True)
class VerticalFit:
    """`thrust_delay_s` and `thrust_lag_s` are known better as `thrust_effect_s`, their sum."""

    hover_thrust: Estimate
    thrust_lag_s: Estimate
    thrust_delay_s: Estimate
    thrust_effect_s: Estimate
    drag_ps: Estimate


@numba.njit(cache=True)
def lagged_thrust(
    times: Array, sent_at: Array, thrust: Array, delay_s: float, lag_s: float
) -> Array:
    """The thrust at `times` (N,): commands (M,) after delay and first-order lag, exact."""
    out = np.empty(times.shape[0])
    row = 0
    while row + 1 < sent_at.shape[0] and sent_at[row + 1] + delay_s <= times[0] - 10.0 * lag_s:
        row += 1
    value = thrust[row]
    now = min(sent_at[row] + delay_s, times[0])
    for i in range(times.shape[0]):
        while now < times[i]:
            following = row + 1
            until = times[i]
            acts = following < sent_at.shape[0] and sent_at[following] + delay_s <= until
            if acts:
                until = max(sent_at[following] + delay_s, now)
            left = math.exp(-(until - now) / lag_s) if lag_s > 1e-6 else 0.0
            value = thrust[row] + (value - thrust[row]) * left
            now = until
            if acts:
                row = following
        out[i] = value if lag_s > 1e-6 else thrust[row]
    return out


@numba.njit(cache=True)
def innovations(
    times: Array,
    positions: Array,
    accelerations: Array,
    drag: float,
    densities: Array,
    sd: float,
    start_sds: Array,
) -> Array:
    """Normalised innovations (N - 1,) of a filter [p, v, d] along one axis.

    v' = a - c v + d with `accelerations` (N,) joined by straight lines; densities (3,) per root
    second of p, v, d; `sd` of the positions; start_sds (2,) of v and d.
    """
    count = times.shape[0]
    out = np.empty(count - 1)
    p, v, d = positions[0], 0.0, 0.0
    pp, pv, pd = sd * sd, 0.0, 0.0
    vv, vd, dd = start_sds[0] ** 2, 0.0, start_sds[1] ** 2
    noise = sd * sd
    for i in range(1, count):
        h = times[i] - times[i - 1]
        keep = math.exp(-drag * h)
        share = (1.0 - keep) / drag if drag > 1e-9 else h
        reach = (h - share) / drag if drag > 1e-6 else 0.5 * h * h
        push = 0.5 * (accelerations[i - 1] + accelerations[i]) + d
        p = p + share * v + reach * push
        v = keep * v + share * push
        # F = [[1, share, reach], [0, keep, share], [0, 0, 1]]; P = F P F' + Q
        a0, a1, a2 = pp + share * pv + reach * pd, pv + share * vv + reach * vd, 0.0
        a2 = pd + share * vd + reach * dd
        b1, b2 = keep * vv + share * vd, keep * vd + share * dd
        pp = a0 + share * a1 + reach * a2 + densities[0] ** 2 * h
        pv = keep * a1 + share * a2
        pd = a2
        vv = keep * b1 + share * b2 + densities[1] ** 2 * h
        vd = b2
        dd = dd + densities[2] ** 2 * h
        spread = pp + noise
        surprise = positions[i] - p
        out[i - 1] = surprise / math.sqrt(spread)
        gain_p, gain_v, gain_d = pp / spread, pv / spread, pd / spread
        p += gain_p * surprise
        v += gain_v * surprise
        d += gain_d * surprise
        dd -= gain_d * pd
        vd -= gain_v * pd
        vv -= gain_v * pv
        pd -= gain_p * pd
        pv -= gain_p * pv
        pp -= gain_p * pp
    return out


class Motion:
    """Positions of a trace with the attitude at their times, thinned to what is worth having."""

    def __init__(self, trace: Trace) -> None:
        rows = trace.position[thinned(trace.position[:, STAMP], STEPS_S)]
        inside = (rows[:, STAMP] >= trace.begin_s) & (rows[:, STAMP] <= trace.end_s)
        rows = rows[inside]
        self.times = np.ascontiguousarray(rows[:, STAMP])
        self.positions = np.ascontiguousarray(rows[:, POSITION].T)
        stamps = trace.attitude[:, STAMP]
        self.direction_ne = np.array(
            [np.interp(self.times, stamps, trace.attitude[:, NORTH + axis]) for axis in (0, 1)]
        )
        self.upright = np.sqrt(np.maximum(1.0 - np.sum(self.direction_ne**2, axis=0), 0.01))
        self._sent_at = np.ascontiguousarray(trace.commands[:, SENT_AT])
        self._thrust = np.ascontiguousarray(trace.commands[:, SENT_THRUST])

    def thrust(self, delay_s: float, lag_s: float) -> Array:
        """Thrust (N,) as a fraction of full throttle."""
        return np.asarray(lagged_thrust(self.times, self._sent_at, self._thrust, delay_s, lag_s))

    @property
    def spacing_s(self) -> float:
        """Mean time from one position to the next."""
        return float(self.times[-1] - self.times[0]) / (len(self.times) - 1)

    @property
    def usable(self) -> bool:
        return len(self.times) >= 50 and len(self._sent_at) >= 3


def fit_drag(motion: Motion, thrust_mps2: Array) -> Estimate:
    """Lateral drag per unit of mass, 1/s; thrust_mps2 (N,) at the motion's times."""
    densities = np.array([POSITION_DENSITY, ACCELERATION_DENSITY, DISTURBANCE_DENSITY])
    starts = np.array([START_SPEED_SD_MPS, START_DISTURBANCE_SD_MPS2])
    pulls = -thrust_mps2 * motion.direction_ne

    def surprises(drag: Array) -> Array:
        return np.concatenate(
            [
                innovations(
                    motion.times,
                    motion.positions[axis],
                    pulls[axis],
                    drag[0],
                    densities,
                    POSITION_SD_M,
                    starts,
                )
                for axis in (0, 1)
            ]
        )

    result = least_squares(
        surprises, [DRAG_START], bounds=([0.0], [DRAG_UPPER]), xtol=1e-4, ftol=1e-9, max_nfev=12
    )
    slope = float(np.sum(result.jac**2))
    if slope <= 0.0:
        return Estimate(float(result.x[0]), math.inf)
    count = len(motion.times) - 1
    lags = min(round(RELATED_S / motion.spacing_s), count // 4)
    score = (result.jac[:, 0] * result.fun).reshape(2, count, 1)
    variance = sum(float(_long_run(rows, lags)[0, 0]) for rows in score)
    return Estimate(float(result.x[0]), math.sqrt(max(variance, 0.0)) / slope)


@dataclass(frozen=True, slots=True)
class VerticalPrior:
    """What is known of the vertical beforehand: where the search for the hover thrust begins, and
    the rest with its uncertainty."""

    hover_thrust: float
    delay_s: Estimate
    lag_s: Estimate
    drag_ps: Estimate


def fit_vertical(motion: Motion, gravity_mps2: float, prior: VerticalPrior) -> VerticalFit:
    """Hover thrust, lag and delay of the thrust."""
    densities = np.array([POSITION_DENSITY, ACCELERATION_DENSITY, VERTICAL_DRIFT])
    starts = np.array([START_SPEED_SD_MPS, 1e-3])
    known = (prior.delay_s, prior.lag_s, prior.drag_ps)

    def surprises(parameters: Array) -> Array:
        inverse, delay_s, lag_s, drag_ps = parameters
        thrust = motion.thrust(delay_s, lag_s)
        pull = gravity_mps2 * (1.0 - inverse * thrust * motion.upright)
        return innovations(
            motion.times, motion.positions[2], pull, drag_ps, densities, POSITION_SD_M, starts
        )

    upper = np.array((50.0, THRUST_DELAY_UPPER_S, LAG_UPPER_S, DRAG_UPPER))
    start = np.clip(
        [1.0 / prior.hover_thrust, *(each.value for each in known)],
        (1.01, *SEARCHED_FROM),
        upper - 1e-3,
    )
    # What is known weighs as much as the innovations really are
    scale = min(float(np.sqrt(np.mean(surprises(start) ** 2))), 1.0)
    means, sds = (np.array([getattr(each, name) for each in known]) for name in ("value", "sd"))
    result = least_squares(
        lambda x: np.concatenate((surprises(x), scale * (x[1:] - means) / sds)),
        start,
        bounds=((1.0, 0.0, 0.0, 0.0), upper),
        x_scale=(1.0, 0.03, 0.03, 0.3),
        xtol=1e-4,
        ftol=1e-6,
        max_nfev=12,
    )
    inverse, delay_s, lag_s, drag_ps = result.x
    covariance = _covariance(result.jac, result.fun, motion.spacing_s, len(known))
    spread = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    effect_sd = math.sqrt(max(float(np.sum(covariance[1:3, 1:3])), 0.0))
    return VerticalFit(
        hover_thrust=Estimate(1.0 / inverse, float(spread[0] / inverse**2)),
        thrust_lag_s=Estimate(lag_s, float(spread[2])),
        thrust_delay_s=Estimate(delay_s, float(spread[1])),
        thrust_effect_s=Estimate(delay_s + lag_s, effect_sd),
        drag_ps=Estimate(drag_ps, float(spread[3])),
    )


def _covariance(jacobian: Array, residual: Array, spacing_s: float, known: int) -> Array:
    """Of least squares on innovations that stay related for RELATED_S, the last `known` rows being
    what was known beforehand."""
    rows = len(residual) - known
    score = jacobian[:rows] * residual[:rows, None]
    lags = min(round(RELATED_S / spacing_s), rows // 4)
    meat = _long_run(score, lags) + jacobian[rows:].T @ jacobian[rows:]
    bread = np.linalg.pinv(jacobian.T @ jacobian)
    covariance: Array = bread @ meat @ bread
    return covariance


def specific_velocity(motion: Motion, vehicle: Vehicle) -> Array:
    """Velocity (3, N) that thrust, attitude and drag alone give, its mean that of the positions."""
    thrust = vehicle.thrust_max_mps2 * motion.thrust(vehicle.thrust_delay_s, vehicle.thrust_lag_s)
    down = vehicle.gravity_mps2 - thrust * motion.upright
    push = np.vstack((-thrust * motion.direction_ne, down))
    push -= push.mean(axis=1, keepdims=True)  # a constant disturbance
    steps = np.diff(motion.times)
    travelled = motion.positions[:, -1] - motion.positions[:, 0]
    mean = travelled / max(motion.times[-1] - motion.times[0], 1e-3)
    push += vehicle.drag_per_mass_ps * mean[:, None]
    velocity = np.empty_like(push)
    velocity[:, 0] = 0.0
    for i, step_s in enumerate(steps):
        keep = math.exp(-vehicle.drag_per_mass_ps * step_s)
        velocity[:, i + 1] = keep * velocity[:, i] + step_s * push[:, i]
    velocity += (mean - velocity.mean(axis=1))[:, None]
    return velocity


def _long_run(score: Array, lags: int) -> Array:
    """Covariance (k, k) of the sum of a related series (N, k) (W. Newey and K. West, 1987)."""
    total: Array = score.T @ score
    for lag in range(1, lags + 1):
        related = score[lag:].T @ score[:-lag]
        total += (1.0 - lag / (lags + 1.0)) * (related + related.T)
    return total
