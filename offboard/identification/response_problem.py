"""Least squares of delay, natural frequency and damping: residuals, search and covariance."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import approx_fprime, least_squares

from offboard.identification.response import free_motion, second_order
from offboard.identification.trace import SPACING_S, thinned
from offboard.identification.uncertainty import (
    FREEDOM,
    lag_count,
    long_run_covariance,
    sandwich,
    scale_of,
    student_t_loss,
    student_t_weights,
)
from offboard.model.vehicle import DAMPING_LIMITS, DELAY_LIMITS_S, FREQUENCY_LIMITS_RADPS

Array = NDArray[np.float64]

# Parameters in this order, with their bounds and the scale of a step of the search.
DELAY, FREQUENCY, DAMPING = 0, 1, 2
LOWER, UPPER = np.array((DELAY_LIMITS_S, FREQUENCY_LIMITS_RADPS, DAMPING_LIMITS)).T
STEP_SCALES = np.array([0.03, 5.0, 0.3])
# Start points: the search goes on from the one that explains most.
STARTS = np.array(
    [(delay_s, frequency, 0.7) for delay_s in (0.02, 0.08, 0.16, 0.3) for frequency in (4.0, 11.0)]
)
# Evaluations of one least-squares search, how often residual weights are computed anew, and the
# relative change of the cost that ends a search: the weights change more than a finer search.
STEPS, ROUNDS, TOLERANCE = 10, 4, 1e-3
FITTED = 5  # parameters and free motion, of each axis
RELATED_S = 0.3  # time over which an attitude estimator's errors are autocorrelated


class ResponseProblem:
    """Least-squares problem of the measured `signals` (N, axes) under `commands` (M, axes).

    With `wanders` the errors of the measurement are a random walk, as those of an estimated course
    are: their steps are independent, and take the place of the residuals.
    """

    def __init__(
        self,
        times: Array,
        signals: Array,
        sent_at: Array,
        commands: Array,
        *,
        wanders: bool = False,
    ) -> None:
        kept = thinned(times, SPACING_S)
        self._times, self._signals = times[kept], signals[kept]
        self._sent_at, self._commands = sent_at, commands
        self._wanders = wanders
        steps_s = np.diff(self._times)
        self._root_steps = np.sqrt(steps_s / steps_s.mean())[:, None]
        self.even_weights = np.ones(len(kept) - wanders)

    def residual(self, parameters: Array, weights: Array) -> Array:
        """Signals less response (N, axes), with free motion and a constant offset projected out
        under `weights` (N,); or their N - 1 steps."""
        left, basis = self._left_and_basis(parameters)
        if self._wanders:
            left = np.diff(left, axis=0) / self._root_steps
            basis = np.diff(basis[:, :2], axis=0) / self._root_steps
        return _projected(left, basis, weights)

    def unexplained(self, parameters: Array) -> float:
        """Sd without outliers of what the response leaves of the signals."""
        left, basis = self._left_and_basis(parameters)
        return scale_of(_projected(left, basis, np.ones(len(left))))

    def _left_and_basis(self, parameters: Array) -> tuple[Array, Array]:
        """Signals less response (N, axes); free motion and a constant (N, 3)."""
        delay_s, frequency, damping = parameters
        left = self._signals - second_order(
            self._times, self._sent_at, self._commands, delay_s, frequency, damping
        )
        basis = np.ones((len(left), 3))
        basis[:, :2] = free_motion(self._times - self._times[0], frequency, damping)[:, 0]
        return left, basis

    def search(self) -> Array:
        """Parameters (3,) of least squares from the best of STARTS, all samples alike."""
        costs = [np.sum(self.residual(start, self.even_weights) ** 2) for start in STARTS]
        return self._least_squares(STARTS[np.argmin(costs)], self.even_weights)

    def refine(self, parameters: Array) -> tuple[Array, Array, float]:
        """The best parameters (3,) for Student's t residuals, their weights (N,) and scale, which
        are computed ROUNDS times from the residuals reached."""
        weights, loss = self.even_weights, partial(student_t_loss, axes=self._signals.shape[1])
        for _ in range(ROUNDS):
            left = self.residual(parameters, weights)
            scale = scale_of(left)
            weights = student_t_weights(left, scale)
            parameters = self._least_squares(parameters, weights, loss=loss, f_scale=scale)
        left = self.residual(parameters, weights)
        scale = scale_of(left)
        return parameters, student_t_weights(left, scale), scale

    def _least_squares(self, start: Array, weights: Array, **options: Any) -> Array:
        found: Array = least_squares(
            lambda parameters: self.residual(parameters, weights).ravel(),
            start,
            bounds=(LOWER, UPPER),
            x_scale=STEP_SCALES,
            ftol=TOLERANCE,
            max_nfev=STEPS,
            **options,
        ).x
        return found

    def covariance(self, best: Array, weights: Array, scale: float) -> Array:
        """Covariance (3, 3) of an M-estimate (Huber, 1967) with autocorrelated residuals; of least
        squares for the independent steps of a measurement that wanders."""
        left = self.residual(best, weights)
        count, axes = left.shape
        slopes = approx_fprime(
            best, lambda tried: self.residual(tried, weights).ravel(), 1e-3 * STEP_SCALES
        )
        if self._wanders:
            variance = np.sum(left**2) / (left.size - FITTED * axes)
            least_squares_covariance: Array = variance * np.linalg.pinv(slopes.T @ slopes)
            return least_squares_covariance
        slopes = slopes.reshape(count, axes, 3)
        spacing_s = (self._times[-1] - self._times[0]) / max(count - 1, 1)
        lags = lag_count(RELATED_S, spacing_s, count)
        far = FREEDOM * scale**2 + np.sum(left**2, axis=1)
        curvature, scores_covariance = np.zeros((3, 3)), np.zeros((3, 3))
        for rows, axis in zip(slopes.swapaxes(0, 1), left.T, strict=True):
            curvatures = weights * (1.0 - 2.0 * axis**2 / far)
            curvature += rows.T @ (curvatures[:, None] * rows)
            scores_covariance += long_run_covariance((weights * axis)[:, None] * rows, lags)
        return sandwich(curvature, scores_covariance)


def _projected(left: Array, basis: Array, weights: Array) -> Array:
    """`left` (N, axes) without its parts along `basis` (N, k), under `weights` (N,)."""
    weighted = basis.T * weights
    gram = weighted @ basis
    gram += np.diag(1e-12 + 1e-9 * np.diag(gram))
    residual: Array = left - basis @ np.linalg.solve(gram, weighted @ left)
    return residual
