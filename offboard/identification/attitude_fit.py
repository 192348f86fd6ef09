"""Delay, natural frequency and damping of tilt and yaw from commanded and measured attitude.

The model is s'' = wn^2 (c(t - delay) - s) - 2 z wn s' (`AxisResponse`). A bounded least-squares
search finds its three parameters; the unknown state at the start and a constant offset are
projected out. A link loses commands, which makes outliers, so residuals are taken for Student's t
(Lange, Little and Taylor, 1989). Times in s, tilt in parts of a unit vector, yaw in rad.
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
# Model error that no residual shows, as sd of delay (s), frequency (relative) and damping: PX4's
# loop is not of second order and gives values this far apart for steps, swings and hover.
MODEL_SDS = (0.002, 0.025, 0.025)
# Limits on the motion that the current estimate leaves unexplained: rad, share of the commanded.
UNEXPLAINED, UNEXPLAINED_SHARE = 0.008, 0.3
OVERDAMPED = 1.5  # least damping
# Of the delay of an overdamped response: three sd stay below the 0.4 s of a delay that is unknown
DELAY_SD_MOST_S = 0.13


FLY_STEPS = "; fly steps"
EXPLAINED = 0.6  # least share of the commanded motion that the fitted response must explain


@dataclass(frozen=True, slots=True)
class Unexplained:
    """What a response leaves unexplained: rms without outliers, and rms of the command about its
    mean; both in the unit of the signal."""

    rms: float
    commanded_rms: float

    @property
    def limit(self) -> float:
        return max(UNEXPLAINED, UNEXPLAINED_SHARE * self.commanded_rms)

    @property
    def contradicts(self) -> bool:
        """Whether telemetry contradicts the response, of the tilt."""
        return self.rms > self.limit


@dataclass(frozen=True, slots=True)
class ResponseFit:
    """An identified axis, its lag 2 z / wn, and what it leaves unexplained."""

    delay_s: Estimate
    natural_frequency_radps: Estimate
    damping: Estimate
    lag_s: Estimate
    left: Unexplained

    @property
    def overdamped(self) -> bool:
        """Whether it is two lags, of 2 z / wn and of about 1 / (2 z wn)."""
        return self.damping.value > OVERDAMPED

    @property
    def shown(self) -> dict[str, Estimate]:
        """The constants that the flight shows, by name. Of an overdamped response natural frequency
        and damping may be at the limits of the search, as little but their ratio shows."""
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
    """Times (N,), thrust directions (N, 2), and when (M,) which (M, 2) were commanded."""
    signals = trace.attitude[:, NORTH : NORTH + 2]
    commands = trace.commands[:, SENT_NORTH : SENT_NORTH + 2]
    return trace.attitude[:, STAMP], signals, trace.commands[:, SENT_AT], commands


def yaw_signals(trace: Trace) -> tuple[Array, Array, Array, Array]:
    """Times (N,), headings (N, 1), and when (M,) which (M, 1) were commanded; rad, unwrapped."""
    signals = np.unwrap(trace.attitude[:, HEADING])[:, None]
    commands = np.unwrap(trace.commands[:, SENT_HEADING])[:, None]
    return trace.attitude[:, STAMP], signals, trace.commands[:, SENT_AT], commands


@dataclass(frozen=True, slots=True)
class Axis:
    """Least commanded motion (rad rms), and the greatest accepted sd of delay (s), natural
    frequency (relative) and damping. Where the response is overdamped, the limit of the delay is
    multiplied by the damping, up to DELAY_SD_MOST_S, the second limit is of the lag 2 z / wn, and
    the third is not used."""

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
    """The response of TILT (both components of the thrust direction) or YAW, in pieces of some
    milliseconds. Returns None, and the reason in `refusals` under the axis's name, if `trace` does
    not determine it. `delay` is what is known of the delay beforehand."""
    attitudes, commands = len(trace.attitude), len(trace.commands)
    if attitudes < 50 or commands < 3:
        refusals[axis.name] = f"{attitudes} attitudes and {commands} commands are too few"
        return None
    problem = ResponseProblem(*axis.signals(trace), wanders=axis.wanders)
    if problem.commanded_rms < axis.least_command_rad:
        refusals[axis.name] = (
            f"its command moved by {1e3 * problem.commanded_rms:.1f} mrad rms, "
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
    """Why a fit is rejected, or empty."""
    left = fit.left
    if left.rms > (1.0 - EXPLAINED) * left.commanded_rms:
        return (
            f"it does not follow its command: {1e3 * left.rms:.1f} mrad rms of "
            f"{1e3 * left.commanded_rms:.1f} commanded are unexplained"
        )
    delay_sd_s, frequency_sd, damping_sd = sd_limits
    if fit.overdamped:  # the delay is hardly told from the lag of 1 / (2 z wn)
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
    """Tilt in `trace` that `response` does not explain."""
    if len(trace.attitude) < 20 or len(trace.commands) < 3:
        return Unexplained(0.0, 0.0)
    parameters = (response.delay_s, response.natural_frequency_radps, response.damping)
    return ResponseProblem(*tilt_signals(trace)).unexplained(np.array(parameters))


def fit_response(
    problem: ResponseProblem, delay: Estimate | None = None
) -> Generator[None, None, ResponseFit]:
    """The response that explains the signals, at least 50, in two pieces. `delay` is what is known
    of the delay beforehand."""
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
    """Least-squares problem of the measured `signals` (N, axes) at `times` (N,) under `commands`
    (M, axes) sent at `sent_at` (M,). `commanded_rms`: of the commands that acted within these
    times, about their mean.

    With `wanders` the errors of the measurement are a random walk, as those of an estimated heading
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
        self.wanders = wanders
        steps_s = np.diff(self._times)
        self._root_steps = np.sqrt(steps_s / steps_s.mean())[:, None]
        self.even_weights = np.ones(len(kept) - wanders)
        acted = commands[(sent_at >= times[0] - UPPER[DELAY]) & (sent_at <= times[-1])]
        away = acted - acted.mean(axis=0) if len(acted) else np.zeros(1)
        self.commanded_rms = float(np.sqrt(np.mean(away**2)))

    def residual(self, parameters: Array, weights: Array) -> Array:
        """Signals less response (N, axes), with free motion and a constant offset projected out
        under `weights` (N,); or their N - 1 steps."""
        left, basis = self._left_and_basis(parameters)
        if self.wanders:
            left = np.diff(left, axis=0) / self._root_steps
            basis = np.diff(basis[:, :2], axis=0) / self._root_steps
        return _projected(left, basis, weights)

    def unexplained(self, parameters: Array) -> Unexplained:
        """What the response leaves of the signals."""
        left, basis = self._left_and_basis(parameters)
        rms = scale_of(_projected(left, basis, np.ones(len(left))))
        return Unexplained(rms, self.commanded_rms)

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
    """`left` (N, axes) without its parts along `basis` (N, k), under `weights` (N,)."""
    weighted = basis.T * weights
    gram = weighted @ basis
    gram += np.diag(1e-12 + 1e-9 * np.diag(gram))
    residual: Array = left - basis @ np.linalg.solve(gram, weighted @ left)
    return residual
