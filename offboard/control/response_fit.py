"""Delay, natural frequency and damping of an attitude loop from what was commanded and what came.

The response s'' = wn^2 (s_c(t - D) - s) - 2 z wn s' is followed exactly from one event to the next
(the command is constant between them), its unknown start is projected out, and three numbers are
left to least squares. Knows signals, no vehicle and no flight. Times in s, signals in rad or parts
of a unit vector.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]

DELAY, FREQUENCY, DAMPING = 0, 1, 2
# Where the search starts: of these the best two are followed to the end.
STARTS = (
    (0.01, 12.0, 1.0),
    (0.06, 11.0, 0.6),
    (0.15, 8.0, 0.7),
    (0.3, 10.0, 0.7),
    (0.15, 3.5, 0.5),
)
FOLLOWED = 2
LOWER = np.array([0.0, 0.5, 0.1])
UPPER = np.array([0.5, 60.0, 3.0])
# Residuals of an estimator wander for this long: the uncertainty counts them as related.
RELATED_S = 0.3


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number and its standard deviation."""

    value: float
    sd: float


@dataclass(frozen=True, slots=True)
class ResponseFit:
    """What was found; `residual_rms` in units of the signal, `commanded_rms` how much the command
    moved."""

    delay_s: Estimate
    natural_frequency_radps: Estimate
    damping: Estimate
    residual_rms: float
    commanded_rms: float


@numba.njit(cache=True)
def _propagator(frequency: float, damping: float, step_s: float) -> tuple[float, float]:
    """f0, f1 with exp(A h) = f0 I + f1 A for A = [[0, 1], [-wn^2, -2 z wn]]."""
    decay = damping * frequency
    square = frequency * frequency * (damping * damping - 1.0)
    if abs(square) * step_s * step_s < 1e-8:
        shrink = math.exp(-decay * step_s)
        return shrink * (1.0 + decay * step_s), shrink * step_s
    if square > 0.0:
        q = math.sqrt(square)
        slow, fast = math.exp((q - decay) * step_s), math.exp((-q - decay) * step_s)
        sine = 0.5 * (slow - fast) / q
        return 0.5 * (slow + fast) + decay * sine, sine
    q = math.sqrt(-square)
    shrink = math.exp(-decay * step_s)
    sine = shrink * math.sin(q * step_s) / q
    return shrink * math.cos(q * step_s) + decay * sine, sine


@numba.njit(cache=True)
def respond(
    times: Array,
    sent_at: Array,
    commands: Array,
    delay_s: float,
    frequency: float,
    damping: float,
    out: Array,
) -> None:
    """The response at `times` (N,) to piecewise constant `commands` (M, axes), at rest on the
    command in force at the start; `out` (N, axes + 2): the axes, then the free responses to a unit
    offset and to a unit rate. Rows in the order of time; exact."""
    axes = commands.shape[1]
    value = np.zeros(axes + 2)
    rate = np.zeros(axes + 2)
    held = np.zeros(axes + 2)
    now = times[0]
    row = -1
    while row + 1 < sent_at.shape[0] and sent_at[row + 1] + delay_s <= now:
        row += 1
    first = max(row, 0)
    for axis in range(axes):
        value[axis] = held[axis] = commands[first, axis]
    value[axes] = 1.0
    rate[axes + 1] = 1.0
    stiffness, friction = frequency * frequency, 2.0 * damping * frequency
    for i in range(times.shape[0]):
        while now < times[i]:
            until = times[i]
            following = row + 1
            acts = following < sent_at.shape[0] and sent_at[following] + delay_s <= until
            if acts:
                until = max(sent_at[following] + delay_s, now)
            f0, f1 = _propagator(frequency, damping, until - now)
            for axis in range(axes + 2):
                away, speed = value[axis] - held[axis], rate[axis]
                value[axis] = held[axis] + f0 * away + f1 * speed
                rate[axis] = f0 * speed + f1 * (-stiffness * away - friction * speed)
            now = until
            if acts:
                row = following
                for axis in range(axes):
                    held[axis] = commands[row, axis]
            elif until >= times[i]:
                break
        for axis in range(axes + 2):
            out[i, axis] = value[axis]


class ResponseProblem:
    """Signals (N, axes) at `times` (N,) under `commands` (M, axes) sent at `sent_at` (M,)."""

    def __init__(self, times: Array, signals: Array, sent_at: Array, commands: Array) -> None:
        self._times = np.ascontiguousarray(times)
        self._sent_at = np.ascontiguousarray(sent_at)
        self._commands = np.ascontiguousarray(commands)
        self._signals = signals
        self._out = np.empty((len(times), signals.shape[1] + 2))

    def residual(self, parameters: Array) -> Array:
        """Signals less response (N, axes), free motion and a constant offset projected out."""
        axes = self._signals.shape[1]
        delay_s, frequency, damping = parameters
        respond(self._times, self._sent_at, self._commands, delay_s, frequency, damping, self._out)
        missing = self._signals - self._out[:, :axes]
        basis = np.linalg.qr(np.column_stack((self._out[:, axes:], np.ones(len(missing)))))[0]
        rest: Array = missing - basis @ (basis.T @ missing)
        return rest

    def solve(self) -> tuple[Array, Array]:
        """The best parameters (3,) and their covariance (3, 3)."""

        def flat(parameters: Array) -> Array:
            return self.residual(parameters).T.reshape(-1)

        starts = sorted(STARTS, key=lambda start: float(np.sum(flat(np.array(start)) ** 2)))
        found = [
            least_squares(
                flat,
                start,
                bounds=(LOWER, UPPER),
                x_scale=(0.03, 5.0, 0.3),
                xtol=1e-5,
                ftol=1e-7,
                gtol=1e-10,
                max_nfev=30,
            )
            for start in starts[:FOLLOWED]
        ]
        best = min(found, key=lambda result: float(result.cost))
        return best.x, self._covariance(best.x, best.jac, best.fun)

    def _covariance(self, parameters: Array, jacobian: Array, residual: Array) -> Array:
        """Of least squares with residuals that are related over RELATED_S (W. Newey and K. West,
        1987, per axis)."""
        count, axes = self._signals.shape
        spacing_s = (self._times[-1] - self._times[0]) / max(count - 1, 1)
        lags = min(max(int(RELATED_S / max(spacing_s, 1e-4)), 1), count // 4)
        meat = np.zeros((3, 3))
        for axis in range(axes):
            rows = slice(axis * count, (axis + 1) * count)
            score = jacobian[rows] * residual[rows, None]
            meat += score.T @ score
            for lag in range(1, lags + 1):
                related = score[lag:].T @ score[:-lag]
                meat += (1.0 - lag / (lags + 1.0)) * (related + related.T)
        bread = np.linalg.pinv(jacobian.T @ jacobian)
        covariance: Array = bread @ meat @ bread
        return covariance


def predicted(
    times: Array,
    sent_at: Array,
    commands: Array,
    delay_s: float,
    frequency_radps: float,
    damping: float,
) -> Array:
    """The response (N, axes) to `commands` (M, axes), at rest at the start."""
    out = np.empty((len(times), commands.shape[1] + 2))
    if len(times) and len(sent_at):
        signal, sent, held = (np.ascontiguousarray(each) for each in (times, sent_at, commands))
        respond(signal, sent, held, delay_s, frequency_radps, damping, out)
    response: Array = out[:, :-2]
    return response


def commanded_rms(times: Array, sent_at: Array, commands: Array) -> float:
    """How much the commands that acted within `times` moved about their mean."""
    within = (sent_at >= times[0] - UPPER[DELAY]) & (sent_at <= times[-1])
    if not within.any():
        return 0.0
    return float(np.sqrt(np.mean((commands[within] - commands[within].mean(axis=0)) ** 2)))


def fit_response(times: Array, signals: Array, sent_at: Array, commands: Array) -> ResponseFit:
    """The response that explains `signals` (N, axes); at least 3 commands and 50 samples."""
    problem = ResponseProblem(times, signals, sent_at, commands)
    best, covariance = problem.solve()
    sds = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    delay, frequency, damping = (
        Estimate(float(value), float(sd)) for value, sd in zip(best, sds, strict=True)
    )
    return ResponseFit(
        delay,
        frequency,
        damping,
        residual_rms=float(np.sqrt(np.mean(problem.residual(best) ** 2))),
        commanded_rms=commanded_rms(times, sent_at, commands),
    )
