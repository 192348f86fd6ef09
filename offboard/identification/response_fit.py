"""Delay, natural frequency and damping of an attitude loop from what was commanded and what came.

The response s'' = wn^2 (s_c(t - D) - s) - 2 z wn s' has three numbers, which a search finds; here
are its starts, the uncertainty of what it finds, and what was known beforehand. Knows signals, no
vehicle and no flight. Times in s, signals in rad or parts of a unit vector.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.identification.response_search import (
    DELAY,
    FREEDOM,
    FREQUENCY,
    LOWER,
    UPPER,
    Data,
    residual,
    residuals,
    respond,
    scale_of,
    search,
    slopes,
    weights_of,
)
from offboard.identification.trace import NORTH, SENT_AT, SENT_NORTH, STAMP, Trace, thinned
from offboard.model.vehicle import AxisResponse

Array = NDArray[np.float64]

# Where the search starts: of these the best two are followed to the end.
STARTS = np.array(
    [
        [0.01, 12.0, 1.0],
        [0.06, 11.0, 0.6],
        [0.15, 8.0, 0.7],
        [0.3, 10.0, 0.7],
        [0.15, 3.5, 0.5],
    ]
)
FOLLOWED = 2
# Residuals of an estimator wander for this long: the uncertainty counts them as related.
RELATED_S = 0.3
SPACING_S = 0.018  # closer samples are thinned: the responses sought are slower
# More than this, and than this share of what was commanded, contradicts what is believed.
UNEXPLAINED, UNEXPLAINED_SHARE = 0.008, 0.3
# What no residual shows: commands act on a grid, and a real loop is not of second order: PX4's,
# fitted to steps, swings or hover, differs by so much (delay s, frequency relative, damping).
MODEL_SDS = (0.002, 0.025, 0.025)


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number and its standard deviation."""

    value: float
    sd: float


@dataclass(frozen=True, slots=True)
class ResponseFit:
    """What was found; `residual_rms`, of the bulk, in units of the signal; `commanded_rms` how
    much the command moved."""

    delay_s: Estimate
    natural_frequency_radps: Estimate
    damping: Estimate
    residual_rms: float
    commanded_rms: float


class ResponseProblem:
    """Signals (N, axes) at `times` (N,) under `commands` (M, axes) sent at `sent_at` (M,)."""

    def __init__(self, times: Array, signals: Array, sent_at: Array, commands: Array) -> None:
        kept = thinned(times, SPACING_S)
        arrays = (times[kept], signals[kept], np.column_stack((sent_at, commands)))
        self._data = Data(*map(np.ascontiguousarray, arrays))

    def residual(self, parameters: Array, weights: Array | None = None) -> Array:
        """Signals less response (N, axes), free motion and a constant offset projected out."""
        if weights is None:
            weights = np.ones(len(self._data.times))
        return residual(self._data, parameters, weights)

    def solve(self) -> tuple[Array, Array, float]:
        """The best parameters (3,), their covariance (3, 3) and the scale of what is left."""
        even = np.ones(len(self._data.times))
        misses = np.sum(residuals(self._data, STARTS, even) ** 2, axis=(1, 2))
        found = [search(self._data, start) for start in STARTS[np.argsort(misses)[:FOLLOWED]]]
        best = min(found, key=lambda each: each[1])[0]
        left = self.residual(best)
        scale = scale_of(left)
        weights = weights_of(left, scale)
        left = self.residual(best, weights)
        return best, self._covariance(best, left, weights, scale), scale

    def _covariance(self, best: Array, left: Array, weights: Array, scale: float) -> Array:
        """Of an M-estimate (P. Huber, 1967) whose residuals are related over RELATED_S (W. Newey
        and K. West, 1987, per axis)."""
        count, axes = left.shape
        slope = slopes(self._data, best, weights, left)
        times = self._data.times
        spacing_s = (times[-1] - times[0]) / max(count - 1, 1)
        lags = min(max(round(RELATED_S / max(spacing_s, 1e-4)), 1), count // 4)
        far = FREEDOM * scale**2 + np.sum(left**2, axis=1)
        meat, bread = np.zeros((3, 3)), np.zeros((3, 3))
        for axis in range(axes):
            rows = slope[:, :, axis].T
            curvature = weights * (1.0 - 2.0 * left[:, axis] ** 2 / far)
            bread += rows.T @ (curvature[:, None] * rows)
            score = (weights * left[:, axis])[:, None] * rows
            meat += score.T @ score
            for lag in range(1, lags + 1):
                related = score[lag:].T @ score[:-lag]
                meat += (1.0 - lag / (lags + 1.0)) * (related + related.T)
        inverse = np.linalg.pinv(bread)
        covariance: Array = inverse @ meat @ inverse
        return covariance


@dataclass(frozen=True, slots=True)
class Unexplained:
    """What a believed tilt response leaves unexplained of a stretch, of the bulk, and how much the
    command moved; parts of a unit vector."""

    scale: float
    moved: float

    @property
    def limit(self) -> float:
        return max(UNEXPLAINED, UNEXPLAINED_SHARE * self.moved)

    @property
    def contradicts(self) -> bool:
        return self.scale > self.limit

    @property
    def told(self) -> str:
        return (
            f"{1e3 * self.scale:.0f} mrad of tilt unexplained (limit {1e3 * self.limit:.0f}) "
            f"of {1e3 * self.moved:.0f} commanded"
        )


def unexplained(trace: Trace, response: AxisResponse) -> Unexplained:
    """By `response`, of the tilt in `trace`."""
    times, sent_at = trace.attitude[:, STAMP], trace.commands[:, SENT_AT]
    if len(times) < 20 or len(sent_at) < 3:
        return Unexplained(0.0, 0.0)
    signals = trace.attitude[:, NORTH : NORTH + 2]
    commands = trace.commands[:, SENT_NORTH : SENT_NORTH + 2]
    parameters = (response.delay_s, response.natural_frequency_radps, response.damping)
    left = ResponseProblem(times, signals, sent_at, commands).residual(np.array(parameters))
    return Unexplained(float(scale_of(left)), commanded_rms(times, sent_at, commands))


def predicted(
    times: Array,
    sent_at: Array,
    commands: Array,
    delay_s: float,
    frequency_radps: float,
    damping: float,
) -> Array:
    """The response (N, axes) to `commands` (M, axes), at rest at the start."""
    axes = commands.shape[1]
    out = np.empty((1, len(times), axes + 2))
    if len(times) and len(sent_at):
        sent = np.column_stack((sent_at, commands))
        steps = np.empty((len(times) + len(sent) + 1, 4))
        parameters = np.array([[delay_s, frequency_radps, damping]])
        respond(np.ascontiguousarray(times), sent, parameters, steps, out)
    response: Array = out[0, :, :axes]
    return response


def commanded_rms(times: Array, sent_at: Array, commands: Array) -> float:
    """How much the commands that acted within `times` moved about their mean."""
    within = (sent_at >= times[0] - UPPER[DELAY]) & (sent_at <= times[-1])
    if not within.any():
        return 0.0
    return float(np.sqrt(np.mean((commands[within] - commands[within].mean(axis=0)) ** 2)))


def fit_response(
    times: Array,
    signals: Array,
    sent_at: Array,
    commands: Array,
    delay: Estimate | None = None,
) -> ResponseFit:
    """The response that explains `signals` (N, axes); at least 3 commands and 50 samples. `delay`
    is what is known of it beforehand."""
    problem = ResponseProblem(times, signals, sent_at, commands)
    best, covariance, scale = problem.solve()
    covariance += np.diag((MODEL_SDS[0], MODEL_SDS[1] * best[FREQUENCY], MODEL_SDS[2])) ** 2
    if delay is not None:
        gain = covariance[:, DELAY] / (covariance[DELAY, DELAY] + delay.sd**2)
        best = np.clip(best + gain * (delay.value - best[DELAY]), LOWER, UPPER)
        covariance = covariance - np.outer(gain, covariance[DELAY])
    sds = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    found = (Estimate(float(value), float(sd)) for value, sd in zip(best, sds, strict=True))
    delay_s, frequency, damping = found
    moved = commanded_rms(times, sent_at, commands)
    return ResponseFit(delay_s, frequency, damping, residual_rms=scale, commanded_rms=moved)
