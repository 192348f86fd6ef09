"""An identified constant with its standard deviation, and the statistics of residuals for it.

Residuals are autocorrelated because the error of an estimator wanders slowly. The covariance of a
fit is therefore the sandwich of Newey and West (1987): inverse curvature of the cost, long-run
covariance of its gradient, inverse curvature. Residuals with outliers are modelled as Student's t
(Lange, Little and Taylor, 1989), with one weight for all axes of a sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FREEDOM = 3.0  # degrees of freedom of Student's t
LEAST_SCALE = 2e-4  # least scale of residuals: all smaller residuals have similar weights


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value and its standard deviation, both in the unit at the end of the name of a variable or
    field; the latter is infinite if nothing is known."""

    value: float
    sd: float

    @property
    def known(self) -> bool:
        """Whether the standard deviation is finite."""
        return math.isfinite(self.sd)


def lag_count(related_s: float, spacing_s: float, samples: int) -> int:
    """Return the number of lags over which samples `spacing_s` apart count as autocorrelated."""
    return min(max(round(related_s / max(spacing_s, 1e-4)), 1), samples // 4)


def long_run_covariance(scores: Array, lags: int) -> Array:
    """Return the covariance (k, k) of the sum of an autocorrelated series `scores` (N, k), with
    Bartlett weights that fall to zero after `lags`.

    A fit makes the sum of `scores` zero. This reduces the covariance by a share that equals the
    mean of the weights; the result is corrected for it (Kiefer and Vogelsang, 2005).
    """
    count = len(scores)
    covariance, weights = scores.T @ scores, float(count)
    for lag in range(1, lags + 1):
        weight = 1.0 - lag / (lags + 1.0)
        related = scores[lag:].T @ scores[:-lag]
        covariance += weight * (related + related.T)
        weights += 2.0 * weight * (count - lag)
    restored: Array = covariance / (1.0 - weights / count**2)
    return restored


def sandwich(curvature: Array, scores_covariance: Array) -> Array:
    """Return the covariance (k, k) of estimates from the curvature J'J of their cost and the
    covariance of its gradient."""
    inverse = np.linalg.pinv(curvature)
    covariance: Array = inverse @ scores_covariance @ inverse
    return covariance


def scale_of(residuals: Array) -> float:
    """Return the standard deviation without outliers, from the median of the magnitudes."""
    return max(float(np.median(np.abs(residuals))) / 0.6745, LEAST_SCALE)


def student_t_weights(residuals: Array, scale: float) -> Array:
    """Return the weights (N,) of `residuals` (N, axes)."""
    axes = residuals.shape[1]
    far = FREEDOM + np.sum(residuals**2, axis=1) / scale**2
    weights: Array = (FREEDOM + axes) / far
    return weights


def student_t_loss(squares: Array, axes: int) -> Array:
    """The `loss` function for scipy.optimize.least_squares: return the loss and its two derivatives
    (3, N axes) for `squares` (N axes,) of scaled residuals."""
    far = FREEDOM + squares.reshape(-1, axes).sum(axis=1)
    slope = (FREEDOM + axes) / far
    loss = (FREEDOM + axes) / axes * np.log(far / FREEDOM)
    return np.repeat((loss, slope, -slope / far), axes, axis=1)
