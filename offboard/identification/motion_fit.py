"""Drag, hover thrust and thrust lag from positions, attitudes and the thrust commanded.

A Kalman filter per axis follows the position under the acceleration that attitude and thrust must
have given, allowing for an estimator that wanders and for a disturbance that drifts; what it could
not foresee, its innovations, is white for the right constants, and least squares on it finds them
(maximum likelihood; L. Ljung, System Identification, 1999, 7.4). Knows arrays and no flight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from offboard.compiled import array, entry, kernel
from offboard.identification.motion import Motion, lagged_thrust
from offboard.identification.response_fit import Estimate

Array = NDArray[np.float64]

# What is allowed for. Per root second: a position that wanders (PX4: .013-.030 m), an acceleration
# that is not modelled (m/s), a disturbance that drifts (m/s^2; PX4's tilt error times g is .1).
# Then: noise of the positions (m), speed and disturbance at the start (m/s, m/s^2).
LATERAL = np.array([0.05, 0.1, 0.08, 0.001, 3.0, 0.5])
# The vertical has no disturbance beside the hover thrust sought.
VERTICAL = np.array([0.05, 0.1, 0.03, 0.001, 3.0, 0.001])
# Innovations of a wandering estimator stay related for this long.
RELATED_S = 2.0

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


@entry(array(1), array(2), array(2), array(1), array(1), array(2))
def innovations(
    times: Array, positions: Array, accelerations: Array, drag: Array, allowed: Array, out: Array
) -> int:
    """Normalised innovations `out` (axes, N - 1) of a filter [p, v, d] along each axis.

    v' = a - c v + d with `accelerations` (axes, N) joined by straight lines and `drag` (1,);
    `allowed` (6,): densities per root second of p, v and d, sd of the positions, and of v and d at
    the start.
    """
    for axis in range(out.shape[0]):
        _filter(times, positions[axis], accelerations[axis], drag[0], allowed, out[axis])
    return 0


@kernel
def _filter(
    times: Array, positions: Array, accelerations: Array, drag: float, allowed: Array, out: Array
) -> None:
    p_density, v_density, d_density = allowed[0], allowed[1], allowed[2]
    noise, start_v, start_d = allowed[3] ** 2, allowed[4] ** 2, allowed[5] ** 2
    p, v, d = positions[0], 0.0, 0.0
    pp, pv, pd = noise, 0.0, 0.0
    vv, vd, dd = start_v, 0.0, start_d
    for i in range(1, times.shape[0]):
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
        pp = a0 + share * a1 + reach * a2 + p_density**2 * h
        pv = keep * a1 + share * a2
        pd = a2
        vv = keep * b1 + share * b2 + v_density**2 * h
        vd = b2
        dd = dd + d_density**2 * h
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


def fit_drag(motion: Motion, thrust_mps2: Array) -> Estimate:
    """Lateral drag per unit of mass, 1/s; thrust_mps2 (N,) at the motion's times."""
    pulls = -thrust_mps2 * motion.direction_ne

    def surprises(drag: Array) -> Array:
        out = np.empty((2, len(motion.times) - 1))
        innovations(motion.times, motion.positions[:2], pulls, drag, LATERAL, out)
        return out.ravel()

    result = least_squares(
        surprises, [DRAG_START], bounds=([0.0], [DRAG_UPPER]), xtol=1e-4, ftol=1e-9, max_nfev=12
    )
    slope = float(np.sum(result.jac**2))
    if slope <= 0.0:
        return Estimate(float(result.x[0]), math.inf)
    count = len(motion.times) - 1
    lags = min(round(RELATED_S / motion.spacing_s), count // 4)
    score = (result.jac[:, 0] * result.fun).reshape(2, count, 1)
    variance = sum(float(long_run(rows, lags)[0, 0]) for rows in score)
    return Estimate(float(result.x[0]), math.sqrt(max(variance, 0.0)) / slope)


@dataclass(frozen=True, slots=True)
class VerticalPrior:
    """What is known of the vertical beforehand: where the search for the hover thrust begins, and
    the rest with its uncertainty."""

    hover_thrust: float
    delay_s: Estimate
    lag_s: Estimate
    drag_ps: Estimate


class _VerticalSurprises:
    """Innovations (N - 1,) along the vertical with inverse hover thrust, delay and lag of the
    thrust, and drag (4,); the next call writes over them."""

    def __init__(self, motion: Motion, gravity_mps2: float) -> None:
        self._gravity_mps2, self._upright = gravity_mps2, motion.upright
        times, height = motion.times, motion.positions[2:]
        self._parameters, self._thrust = np.empty(4), np.empty(len(times))
        self._pull, self._out = np.empty_like(height), np.empty((1, len(times) - 1))
        delay_and_lag_s, drag = self._parameters[1:3], self._parameters[3:]
        self._lag = partial(lagged_thrust, times, motion.sent, delay_and_lag_s, self._thrust)
        self._filter = partial(innovations, times, height, self._pull, drag, VERTICAL, self._out)

    def __call__(self, parameters: Array) -> Array:
        self._parameters[:] = parameters
        self._lag()
        inverse = self._parameters[0]
        self._pull[0] = self._gravity_mps2 * (1.0 - inverse * self._thrust * self._upright)
        self._filter()
        surprises: Array = self._out[0]
        return surprises


def fit_vertical(motion: Motion, gravity_mps2: float, prior: VerticalPrior) -> VerticalFit:
    """Hover thrust, lag and delay of the thrust."""
    known = (prior.delay_s, prior.lag_s, prior.drag_ps)
    surprises = _VerticalSurprises(motion, gravity_mps2)
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
    meat = long_run(score, lags) + jacobian[rows:].T @ jacobian[rows:]
    bread = np.linalg.pinv(jacobian.T @ jacobian)
    covariance: Array = bread @ meat @ bread
    return covariance


def long_run(score: Array, lags: int) -> Array:
    """Covariance (k, k) of the sum of a related series (N, k) (W. Newey and K. West, 1987)."""
    apart = np.arange(lags + 1)
    related = np.array([score[lag:].T @ score[: len(score) - lag] for lag in apart.tolist()])
    terms = (1.0 - apart / (lags + 1.0))[:, None, None] * (related + related.swapaxes(1, 2))
    terms[0] = related[0]
    total: Array = np.cumsum(terms, axis=0)[-1]
    return total
