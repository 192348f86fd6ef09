"""Drag, hover thrust, thrust lag and thrust delay from positions, attitudes and commanded thrust.

A Kalman filter per axis follows the reported position, with the acceleration that attitude and
thrust cause. It models an estimator error that wanders and a disturbance that drifts. With the
right constants its innovations are white; least squares of the innovations finds these constants
(maximum likelihood; Ljung, System Identification, 1999, 7.4). The reported velocity is not used,
because on PX4 it is not the derivative of the reported position. SI, NED.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from offboard.identification.response import first_order, linear_recursion
from offboard.identification.trace import (
    NORTH,
    POSITION,
    SENT_AT,
    SENT_THRUST,
    SPACING_S,
    STAMP,
    Trace,
    thinned,
)
from offboard.identification.uncertainty import (
    Estimate,
    lag_count,
    long_run_covariance,
    sandwich,
    scale_of,
)

Array = NDArray[np.float64]

LEAST_NOISE_M = 0.001
COARSE_SPACING_S = 0.036  # used in flight instead of SPACING_S
SPEED_OVER_S = 0.5  # time over which a speed is measured
RELATED_S = 2.0  # time over which innovations of a wandering estimator are autocorrelated
# Time constant of the rate at which the estimated position wanders: estimators smooth it. A model
# with a white rate added 30 ms to the delay of the thrust, because feedback responds to the wander
WANDER_S = 0.4

DRAG_UPPER_PS = 5.0
# Least start values of inverse hover thrust, delay (s), lag (s) and drag (1/s): without a lag the
# thrust jumps between samples, and its derivative with respect to the delay is zero
STARTED_FROM = (1.01, 0.005, 0.03, 0.01)
LAG_UPPER_S, THRUST_DELAY_UPPER_S = 0.4, 0.5
# Model error that innovations do not show: feedback of the wander makes the delay 10 ms longer and
# the lag 10 ms shorter; their sum is right
SPLIT_SD_S = 0.006


class Motion:
    """Positions of a trace, at least `spacing_s` apart, with the attitude at their times.

    `times` (N,), `positions` (3, N) NED in m, `direction_ne` (2, N) thrust direction north and
    east, `b_z` (N,) its down component.
    """

    def __init__(self, trace: Trace, spacing_s: float = SPACING_S) -> None:
        rows = trace.position[thinned(trace.position[:, STAMP], spacing_s)]
        rows = rows[(rows[:, STAMP] >= trace.begin_s) & (rows[:, STAMP] <= trace.end_s)]
        self.times = rows[:, STAMP]
        self.positions = rows[:, POSITION].T
        stamps = trace.attitude[:, STAMP]
        self.direction_ne = np.array(
            [np.interp(self.times, stamps, trace.attitude[:, NORTH + axis]) for axis in (0, 1)]
        )
        self.b_z = np.sqrt(np.maximum(1.0 - np.sum(self.direction_ne**2, axis=0), 0.01))
        self._sent_at = trace.commands[:, SENT_AT]
        self._sent_thrust = trace.commands[:, SENT_THRUST, None]

    def thrust(self, delay_s: float, lag_s: float) -> Array:
        """Return the thrust (N,), a fraction of full throttle, after delay and first-order lag."""
        return first_order(self.times, self._sent_at, self._sent_thrust, delay_s, lag_s)[:, 0]

    @property
    def spacing_s(self) -> float:
        """Mean time from one position to the next."""
        return float(self.times[-1] - self.times[0]) / (len(self.times) - 1)

    @property
    def speed_mps(self) -> float:
        """Horizontal speed, rms, from positions SPEED_OVER_S apart."""
        ends = self.times + SPEED_OVER_S
        within = ends <= self.times[-1]
        if not within.any():
            return 0.0
        moved = [
            np.interp(ends[within], self.times, along) - along[within]
            for along in self.positions[:2]
        ]
        return float(np.sqrt(np.mean(np.sum(np.square(moved), axis=0)))) / SPEED_OVER_S

    def noise_m(self, axes: slice) -> float:
        """Return the sd of the white noise of positions, from third differences, in which motion
        cancels; at least LEAST_NOISE_M."""
        third = np.diff(self.positions[axes], n=3)
        return max(scale_of(third) / math.sqrt(20.0), LEAST_NOISE_M)

    @property
    def sufficient(self) -> bool:
        """Whether there are enough positions and commands for a fit."""
        return len(self.times) >= 50 and len(self._sent_at) >= 3

    @property
    def counts(self) -> str:
        return f"{len(self.times)} positions and {len(self._sent_at)} commands"


# ---------------------------------------------------------------------- Kalman filter


# Noise of the filter, per root second: wander of the position over times longer than WANDER_S (m)
# and acceleration that is not modelled (m/s). Sd of the velocity at the start (m/s)
WANDER_M, ACCELERATION_MPS, START_VELOCITY_MPS = 0.12, 0.1, 3.0
# Disturbance: drift per root second (m/s^2; PX4: tilt error times g, 0.1), and sd at the start
# (m/s^2), which is small vertically, because the hover thrust that is fitted contains it
LATERAL, VERTICAL = (0.08, 0.5), (0.03, 0.001)


class PositionFilter:
    """Kalman filter of position, velocity, disturbance and rate of the wander [p, v, d, w], with
    p' = v + w, v' = a - drag v + d, w' = -w / WANDER_S.

    Its gains are computed for `drag_ps`, where a search begins, and hardly depend on it. With fixed
    gains the variance of the innovations is fixed too, so their sum of squares is a likelihood.
    `noise_m` is the sd of the white noise of positions, `disturbance` is LATERAL or VERTICAL.
    """

    def __init__(
        self, times: Array, drag_ps: float, noise_m: float, disturbance: tuple[float, float]
    ) -> None:
        self._steps_s = np.diff(times)
        wander, (drift, start_disturbance) = WANDER_M / WANDER_S, disturbance
        growth = np.diag(np.square((0.0, ACCELERATION_MPS, drift, wander)))
        variance = noise_m**2
        start_wander = wander**2 * WANDER_S / 2.0  # stationary variance
        covariance = np.diag((variance, START_VELOCITY_MPS**2, start_disturbance**2, start_wander))
        self._gains = np.empty((len(self._steps_s), 4))
        self._sds = np.empty(len(self._steps_s))
        steps = zip(self._steps_s, motion_transitions(self._steps_s, drag_ps), strict=True)
        for i, (step_s, transition) in enumerate(steps):
            covariance = transition @ covariance @ transition.T + growth * step_s
            innovation_variance = covariance[0, 0] + variance
            gain = covariance[0] / innovation_variance
            covariance = covariance - gain[:, None] * covariance[0]
            self._gains[i], self._sds[i] = gain, math.sqrt(innovation_variance)

    def innovations(self, positions: Array, accelerations: Array, drag_ps: float) -> Array:
        """Return normalised innovations (axes, N - 1) for `positions` (axes, N) and `accelerations`
        (axes, N) without drag, which are interpolated linearly."""
        transitions = motion_transitions(self._steps_s, drag_ps)
        mean = 0.5 * (accelerations[:, 1:] + accelerations[:, :-1]).T[:, None]
        # The mean acceleration over a step acts like a disturbance of this step only
        driven = transitions[:, :, 2:3] * mean
        driven[:, 2] = 0.0
        kept = np.eye(4) - self._gains[:, :, None] * np.array((1.0, 0.0, 0.0, 0.0))
        states = np.zeros((len(positions.T), 4, len(positions)))
        states[0, 0] = positions[:, 0]
        states[1:] = kept @ driven + self._gains[:, :, None] * positions.T[1:, None]
        states = linear_recursion(kept @ transitions, states)
        predicted = (transitions[:, :1] @ states[:-1] + driven[:, :1])[:, 0]
        surprises: Array = ((positions.T[1:] - predicted) / self._sds[:, None]).T
        return surprises


def motion_transitions(steps_s: Array, drag_ps: float) -> Array:
    """Return transitions (N, 4, 4) of [p, v, d, w] over `steps_s` (N,), with p' = v + w,
    v' = d - drag v, d' = 0, w' = -w / WANDER_S."""
    drag_ps = max(drag_ps, 1e-6)
    transitions = np.zeros((len(steps_s), 4, 4))
    transitions[:, 0, 0] = transitions[:, 2, 2] = 1.0
    transitions[:, 1, 1] = np.exp(-drag_ps * steps_s)
    transitions[:, 0, 1] = transitions[:, 1, 2] = -np.expm1(-drag_ps * steps_s) / drag_ps
    transitions[:, 0, 2] = (steps_s - transitions[:, 0, 1]) / drag_ps
    transitions[:, 3, 3] = np.exp(-steps_s / WANDER_S)
    transitions[:, 0, 3] = WANDER_S * (1.0 - transitions[:, 3, 3])
    return transitions


# ---------------------------------------------------------------------- fits


def fit_drag(motion: Motion, thrust_mps2: Array, start_ps: float) -> Estimate:
    """Fit the lateral drag per unit of mass, 1/s; the search begins at `start_ps`. `thrust_mps2`
    (N,) is the thrust at the motion's times."""
    start_ps = min(max(start_ps, STARTED_FROM[3]), 0.9 * DRAG_UPPER_PS)
    accelerations = -thrust_mps2 * motion.direction_ne
    lateral = PositionFilter(motion.times, start_ps, motion.noise_m(slice(2)), LATERAL)
    found = least_squares(
        lambda drag: lateral.innovations(motion.positions[:2], accelerations, drag[0]).ravel(),
        [start_ps],
        bounds=([0.0], [DRAG_UPPER_PS]),
        xtol=1e-4,
        ftol=1e-9,
        max_nfev=12,
    )
    curvature = found.jac.T @ found.jac
    if curvature[0, 0] <= 0.0:
        return Estimate(float(found.x[0]), math.inf)
    count = len(motion.times) - 1
    lags = lag_count(RELATED_S, motion.spacing_s, count)
    north, east = (found.jac[:, 0] * found.fun).reshape(2, count, 1)
    scores_covariance = long_run_covariance(north, lags) + long_run_covariance(east, lags)
    variance = float(sandwich(curvature, scores_covariance)[0, 0])
    return Estimate(float(found.x[0]), math.sqrt(max(variance, 0.0)))


def fit_vertical(
    motion: Motion,
    gravity_mps2: float,
    hover_thrust: float,
    delay_s: Estimate,
    lag_s: Estimate,
    drag_ps: Estimate,
) -> dict[str, Estimate]:
    """Fit hover thrust, and delay and lag of the thrust. The search begins at `hover_thrust`; the
    other arguments are prior estimates. Return estimates by name. `thrust_effect_s`, the sum of
    delay and lag, is better determined than its parts."""
    known = (delay_s, lag_s, drag_ps)
    means = np.array([each.value for each in known])
    sds = np.array([each.sd for each in known])
    upper = np.array((50.0, THRUST_DELAY_UPPER_S, LAG_UPPER_S, DRAG_UPPER_PS))
    start = np.clip([1.0 / hover_thrust, *means], STARTED_FROM, upper - 1e-3)
    vertical = PositionFilter(motion.times, start[3], motion.noise_m(slice(2, 3)), VERTICAL)

    def innovations(parameters: Array) -> Array:
        inverse, delay, lag, drag = parameters
        thrust = inverse * motion.thrust(delay, lag)
        accelerations = gravity_mps2 * (1.0 - thrust * motion.b_z)
        heights, only = motion.positions[2:], accelerations[None]
        surprises: Array = vertical.innovations(heights, only, drag)[0]
        return surprises

    # Each prior counts as one innovation; its weight follows the rms of the innovations
    scale = min(float(np.sqrt(np.mean(innovations(start) ** 2))), 1.0)
    found = least_squares(
        lambda x: np.concatenate((innovations(x), scale * (x[1:] - means) / sds)),
        start,
        bounds=((1.0, 0.0, 0.0, 0.0), upper),
        x_scale=(1.0, 0.03, 0.03, 0.3),
        xtol=1e-4,
        ftol=1e-6,
        max_nfev=12,
    )
    inverse, delay, lag, _ = found.x.tolist()
    rows = len(motion.times) - 1
    lags = lag_count(RELATED_S, motion.spacing_s, rows)
    scores_covariance = long_run_covariance(found.jac[:rows] * found.fun[:rows, None], lags)
    scores_covariance += found.jac[rows:].T @ found.jac[rows:]
    covariance = sandwich(found.jac.T @ found.jac, scores_covariance)
    covariance[1:3, 1:3] += SPLIT_SD_S**2 * np.array(((1.0, -1.0), (-1.0, 1.0)))
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
    effect_sd_s = math.sqrt(max(float(np.sum(covariance[1:3, 1:3])), 0.0))
    return {
        "hover_thrust": Estimate(1.0 / inverse, sd[0] / inverse**2),
        "thrust_delay_s": Estimate(delay, sd[1]),
        "thrust_lag_s": Estimate(lag, sd[2]),
        "thrust_effect_s": Estimate(delay + lag, effect_sd_s),
    }
