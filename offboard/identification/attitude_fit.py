"""Delay, natural frequency and damping of tilt and yaw from commanded and measured attitude.

The model is s'' = wn^2 (c(t - delay) - s) - 2 z wn s' (`AxisResponse`). A bounded least-squares
search finds its three parameters; the unknown initial state and a constant offset are projected
out. Commands lost by the link cause outliers, so residuals are modelled as Student's t (Lange,
Little and Taylor, 1989). Times are in s, tilt is in components of a unit vector, yaw in rad.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import approx_fprime, least_squares

from offboard.identification.response import free_motion, second_order
from offboard.identification.trace import (
    HEADING,
    NORTH,
    SENT_AT,
    SENT_HEADING,
    SENT_NORTH,
    SPACING_S,
    STAMP,
    Trace,
    thinned,
)
from offboard.identification.uncertainty import (
    FREEDOM,
    Estimate,
    lag_count,
    long_run_covariance,
    sandwich,
    scale_of,
    student_t_loss,
    student_t_weights,
)
from offboard.model.vehicle import (
    DAMPING_LIMITS,
    DELAY_LIMITS_S,
    FREQUENCY_LIMITS_RADPS,
    AxisResponse,
)

Array = NDArray[np.float64]

# Indices of the parameters, their bounds, and their scales in the search
DELAY, FREQUENCY, DAMPING = 0, 1, 2
LOWER, UPPER = np.array((DELAY_LIMITS_S, FREQUENCY_LIMITS_RADPS, DAMPING_LIMITS)).T
STEP_SCALES = np.array([0.03, 5.0, 0.3])
# Start points: the search begins at the one with the smallest residuals
STARTS = np.array(
    [(delay_s, frequency, 0.7) for delay_s in (0.02, 0.08, 0.16, 0.3) for frequency in (4.0, 11.0)]
)
# Evaluations of one least-squares search, number of searches with new residual weights, and the
# relative change of the cost that ends a search (a finer search changes less than the weights do)
STEPS, ROUNDS, TOLERANCE = 10, 4, 1e-3
FITTED = 5  # fitted numbers per axis: three parameters and two of the free motion
RELATED_S = 0.3  # time over which an attitude estimator's errors are autocorrelated
# Model error that residuals do not show, as sd of delay (s), frequency (relative) and damping:
# PX4's loop is not of second order; fits to steps, swings and hover differ this much
MODEL_SDS = (0.002, 0.025, 0.025)
# Limits of the motion that the response in use leaves unexplained: rad, share of the commanded
UNEXPLAINED, UNEXPLAINED_SHARE = 0.008, 0.3
OVERDAMPED = 1.5  # a response with more damping counts as overdamped
# Largest sd of the delay of an overdamped response: three sd are less than the uncertainty of an
# unknown delay, 0.4 s
DELAY_SD_MOST_S = 0.13


FLY_STEPS = "; fly steps"
EXPLAINED = 0.6  # least share of the commanded motion that the fitted response must explain


@dataclass(frozen=True, slots=True)
class Unexplained:
    """The part of a signal that a response does not explain: its rms without outliers, and for
    comparison the rms of the command about its mean; both in the unit of the signal."""

    rms: float
    commanded_rms: float

    @property
    def limit(self) -> float:
        return max(UNEXPLAINED, UNEXPLAINED_SHARE * self.commanded_rms)

    @property
    def contradicts(self) -> bool:
        """Whether telemetry contradicts the response (used for the tilt)."""
        return self.rms > self.limit


@dataclass(frozen=True, slots=True)
class ResponseFit:
    """The identified response of an axis, its lag 2 z / wn, and what it leaves unexplained."""

    delay_s: Estimate
    natural_frequency_radps: Estimate
    damping: Estimate
    lag_s: Estimate
    left: Unexplained

    @property
    def overdamped(self) -> bool:
        """Whether the response equals two lags, of about 2 z / wn and 1 / (2 z wn)."""
        return self.damping.value > OVERDAMPED

    @property
    def shown(self) -> dict[str, Estimate]:
        """The constants that the flight determines, by name. It hardly determines more than the
        ratio of natural frequency and damping of an overdamped response, so that both may be at the
        limits of the search."""
        if self.overdamped:
            return {"delay_s": self.delay_s, "lag_s": self.lag_s}
        return {
            "delay_s": self.delay_s,
            "natural_frequency_radps": self.natural_frequency_radps,
            "damping": self.damping,
        }

    @property
    def response(self) -> AxisResponse:
        return AxisResponse(
            delay_s=self.delay_s.value,
            natural_frequency_radps=self.natural_frequency_radps.value,
            damping=self.damping.value,
        )


def tilt_signals(trace: Trace) -> tuple[Array, Array, Array, Array]:
    """Return times (N,), thrust directions north and east (N, 2), and times (M,) and thrust
    directions (M, 2) of commands."""
    signals = trace.attitude[:, NORTH : NORTH + 2]
    commands = trace.commands[:, SENT_NORTH : SENT_NORTH + 2]
    return trace.attitude[:, STAMP], signals, trace.commands[:, SENT_AT], commands


def yaw_signals(trace: Trace) -> tuple[Array, Array, Array, Array]:
    """Return times (N,), headings (N, 1), and times (M,) and headings (M, 1) of commands; rad,
    unwrapped."""
    signals = np.unwrap(trace.attitude[:, HEADING])[:, None]
    commands = np.unwrap(trace.commands[:, SENT_HEADING])[:, None]
    return trace.attitude[:, STAMP], signals, trace.commands[:, SENT_AT], commands


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis, with the least commanded motion (rad rms) and `sd_limits`, the greatest accepted sd
    of delay (s), natural frequency (relative) and damping. For an overdamped response the limit of
    the delay is multiplied by the damping, up to DELAY_SD_MOST_S, the second limit applies to the
    lag 2 z / wn, and the third is not used."""

    name: str
    signals: Callable[[Trace], tuple[Array, Array, Array, Array]]
    least_command_rad: float
    sd_limits: tuple[float, float, float]
    wanders: bool  # see `ResponseProblem`


TILT = Axis("tilt", tilt_signals, 0.004, (0.03, 0.15, 0.15), wanders=False)
YAW = Axis("yaw", yaw_signals, 0.008, (0.04, 0.15, 0.2), wanders=True)


def fit_axis(
    axis: Axis, trace: Trace, refusals: dict[str, str], delay: Estimate | None = None
) -> Generator[None, None, ResponseFit | None]:
    """Fit the response of TILT (both components of the thrust direction) or YAW, in pieces of some
    milliseconds. Return None, and set the reason in `refusals` under the axis's name, if `trace`
    does not determine it. `delay` is the prior estimate of the delay."""
    attitudes, commands = len(trace.attitude), len(trace.commands)
    if attitudes < 50 or commands < 3:
        refusals[axis.name] = f"{attitudes} attitudes and {commands} commands are too few"
        return None
    problem = ResponseProblem(*axis.signals(trace), wanders=axis.wanders)
    if problem.commanded_rms < axis.least_command_rad:
        refusals[axis.name] = (
            f"its command changed by only {1e3 * problem.commanded_rms:.1f} mrad rms, "
            f"{1e3 * axis.least_command_rad:.0f} mrad are needed: fly steps"
        )
        return None
    fit = yield from fit_response(problem, delay)
    refusal = _refusal(fit, axis.sd_limits)
    if refusal:
        refusals[axis.name] = refusal
        return None
    return fit


def _refusal(fit: ResponseFit, sd_limits: tuple[float, float, float]) -> str:
    """Return why a fit is rejected; empty if it is accepted."""
    left = fit.left
    if left.rms > (1.0 - EXPLAINED) * left.commanded_rms:
        return (
            f"it does not follow its command: {1e3 * left.rms:.1f} mrad rms of "
            f"{1e3 * left.commanded_rms:.1f} commanded are unexplained"
        )
    delay_sd_s, frequency_sd, damping_sd = sd_limits
    if fit.overdamped:  # the delay can hardly be distinguished from the lag of 1 / (2 z wn)
        delay_sd_s = min(delay_sd_s * fit.damping.value, DELAY_SD_MOST_S)
    margins = 1e-3 * (UPPER - LOWER)
    least, most = (LOWER + margins).tolist(), (UPPER - margins).tolist()
    # name, limit of the sd, least and greatest value
    checks = {
        "delay_s": ("delay (s)", delay_sd_s, -math.inf, most[DELAY]),
        "natural_frequency_radps": (
            "natural frequency (rad/s)", frequency_sd * fit.natural_frequency_radps.value,
            least[FREQUENCY], most[FREQUENCY],
        ),
        "damping": ("damping", damping_sd, least[DAMPING], most[DAMPING]),
        "lag_s": ("lag (s)", frequency_sd * fit.lag_s.value, 0.0, math.inf),
    }  # fmt: skip
    for key, estimate in fit.shown.items():
        name, limit, lowest, highest = checks[key]
        if not lowest <= estimate.value <= highest:
            return f"its {name} is at the limit of the search, {estimate.value:.3g}"
        if not estimate.sd <= limit:
            return f"its {name} is uncertain: sd {estimate.sd:.2g}, limit {limit:.2g}{FLY_STEPS}"
    return ""


def unexplained(trace: Trace, response: AxisResponse) -> Unexplained:
    """Return the tilt in `trace` that `response` does not explain; zero for a short trace."""
    if len(trace.attitude) < 20 or len(trace.commands) < 3:
        return Unexplained(0.0, 0.0)
    parameters = (response.delay_s, response.natural_frequency_radps, response.damping)
    return ResponseProblem(*tilt_signals(trace)).unexplained(np.array(parameters))


def fit_response(
    problem: ResponseProblem, delay: Estimate | None = None
) -> Generator[None, None, ResponseFit]:
    """Fit the response to the signals, at least 50, in two pieces. `delay` is the prior estimate of
    the delay."""
    start = problem.search()
    yield
    best, weights, scale = problem.refine(start)
    covariance = problem.covariance(best, weights, scale)
    covariance += np.diag((MODEL_SDS[0], MODEL_SDS[1] * best[FREQUENCY], MODEL_SDS[2])) ** 2
    if delay is not None:  # Kalman update
        gain = covariance[:, DELAY] / (covariance[DELAY, DELAY] + delay.sd**2)
        best = np.clip(best + gain * (delay.value - best[DELAY]), LOWER, UPPER)
        covariance = covariance - np.outer(gain, covariance[DELAY])
    sds = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    lag_slope = 2.0 / best[FREQUENCY] * np.array((0.0, -best[DAMPING] / best[FREQUENCY], 1.0))
    lag_sd_s = math.sqrt(max(lag_slope @ covariance @ lag_slope, 0.0))
    found = (Estimate(float(value), float(sd)) for value, sd in zip(best, sds, strict=True))
    delay_s, frequency, damping = found
    lag_s = Estimate(2.0 * damping.value / frequency.value, lag_sd_s)
    left = (
        problem.unexplained(best) if problem.wanders else Unexplained(scale, problem.commanded_rms)
    )
    return ResponseFit(delay_s, frequency, damping, lag_s, left)


# ---------------------------------------------------------------------- least squares


class ResponseProblem:
    """Least-squares problem of the measured `signals` (N, axes) at `times` (N,) with `commands`
    (M, axes) sent at `sent_at` (M,). `commanded_rms` is the rms about their mean of the commands
    that acted within these times.

    With `wanders`, the errors of the measurement are a random walk, as those of an estimated
    heading are. Their steps are independent, so the steps of the residuals are fitted instead.
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
        self.wanders = wanders
        steps_s = np.diff(self._times)
        self._root_steps = np.sqrt(steps_s / steps_s.mean())[:, None]
        self.even_weights = np.ones(len(kept) - wanders)
        acted = commands[(sent_at >= times[0] - UPPER[DELAY]) & (sent_at <= times[-1])]
        away = acted - acted.mean(axis=0) if len(acted) else np.zeros(1)
        self.commanded_rms = float(np.sqrt(np.mean(away**2)))

    def residual(self, parameters: Array, weights: Array) -> Array:
        """Return signals minus response (N, axes), or with `wanders` their N - 1 steps. Free motion
        and a constant offset are projected out with `weights` (N,)."""
        left, basis = self._left_and_basis(parameters)
        if self.wanders:
            left = np.diff(left, axis=0) / self._root_steps
            basis = np.diff(basis[:, :2], axis=0) / self._root_steps
        return _projected(left, basis, weights)

    def unexplained(self, parameters: Array) -> Unexplained:
        """Return the part of the signals that the response does not explain."""
        left, basis = self._left_and_basis(parameters)
        rms = scale_of(_projected(left, basis, np.ones(len(left))))
        return Unexplained(rms, self.commanded_rms)

    def _left_and_basis(self, parameters: Array) -> tuple[Array, Array]:
        """Return signals minus response (N, axes), and free motion and a constant (N, 3)."""
        delay_s, frequency, damping = parameters
        left = self._signals - second_order(
            self._times, self._sent_at, self._commands, delay_s, frequency, damping
        )
        basis = np.ones((len(left), 3))
        basis[:, :2] = free_motion(self._times - self._times[0], frequency, damping)[:, 0]
        return left, basis

    def search(self) -> Array:
        """Return the parameters (3,) of least squares with equal weights, searched from the best
        of STARTS."""
        costs = [np.sum(self.residual(start, self.even_weights) ** 2) for start in STARTS]
        return self._least_squares(STARTS[np.argmin(costs)], self.even_weights)

    def refine(self, parameters: Array) -> tuple[Array, Array, float]:
        """Return the best parameters (3,) for Student's t residuals, and the weights (N,) and scale
        of these, which are computed from the latest residuals in each of ROUNDS searches."""
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
        """Return the covariance (3, 3) of an M-estimate (Huber, 1967) with autocorrelated
        residuals, or with `wanders` that of least squares with independent residuals."""
        left = self.residual(best, weights)
        count, axes = left.shape
        slopes = approx_fprime(
            best, lambda tried: self.residual(tried, weights).ravel(), 1e-3 * STEP_SCALES
        )
        if self.wanders:
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
    """Return `left` (N, axes) with `basis` (N, k) projected out, with `weights` (N,)."""
    weighted = basis.T * weights
    gram = weighted @ basis
    gram += np.diag(1e-12 + 1e-9 * np.diag(gram))
    residual: Array = left - basis @ np.linalg.solve(gram, weighted @ left)
    return residual
