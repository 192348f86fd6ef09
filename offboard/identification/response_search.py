"""The response of a second-order loop to commands held between events, and the search for its
three parameters, with a bounded number of steps, so that it takes some milliseconds. Only the
response is compiled: the rest is a few operations on long arrays.

The command is constant from one event to the next, so the response is followed exactly; its
unknown start and offset are projected out. A link loses commands, and what follows a lost one
tells of no response: residuals are taken for Student's t, so that they weigh less the larger they
are (K. Lange, R. Little and J. Taylor, 1989). Times in s, signals in any unit; knows arrays only.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import array, entry, kernel

Array = NDArray[np.float64]

DELAY, FREQUENCY, DAMPING = 0, 1, 2
LOWER = np.array([0.0, 0.5, 0.1])
UPPER = np.array([0.5, 60.0, 3.0])
FREEDOM = 3.0  # of Student's t
LEAST_SCALE = 2e-4  # of residuals: below it all weigh the same
PLAIN_STEPS, STEPS, DESCENTS = 4, 14, 6  # unweighted at first; of one search; tries of one step
STEP_SCALES = np.array([0.03, 5.0, 0.3])
CONVERGED = 2e-4  # of STEP_SCALES
DIFFERENCE = 1e-3  # of them too, for slopes

# Columns of a table of steps: the propagator, the row of the command held, the sample led to.
F0, F1, HELD, SAMPLE = 0, 1, 2, 3


@kernel
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


@kernel
def _divide(k: int, times: Array, sent: Array, parameters: Array, steps: Array) -> None:
    """The `steps` of constant command that lead from sample to sample, and a last one of no
    sample."""
    delay_s, frequency, damping = parameters[k, 0], parameters[k, 1], parameters[k, 2]
    now = times[0]
    row = -1
    while row + 1 < sent.shape[0] and sent[row + 1, 0] + delay_s <= now:
        row += 1
    step = 0
    steps[0, HELD] = max(row, 0)
    for i in range(times.shape[0]):
        while now < times[i]:
            until = times[i]
            acts = row + 1 < sent.shape[0] and sent[row + 1, 0] + delay_s <= until
            if acts:
                until = max(sent[row + 1, 0] + delay_s, now)
            steps[step, F0], steps[step, F1] = _propagator(frequency, damping, until - now)
            steps[step, HELD], steps[step, SAMPLE] = max(row, 0), i
            step += 1
            now = until
            if acts:
                row += 1
    steps[step, SAMPLE] = times.shape[0]


@kernel
def _follow(k: int, column: int, sent: Array, parameters: Array, steps: Array, out: Array) -> None:
    """One column of `out`."""
    frequency, damping = parameters[k, 1], parameters[k, 2]
    stiffness, friction = frequency * frequency, 2.0 * damping * frequency
    axes = sent.shape[1] - 1
    commanded = column < axes
    held = sent[int(steps[0, HELD]), 1 + column] if commanded else 0.0
    value = 1.0 if column == axes else held
    rate = 1.0 if column == axes + 1 else 0.0
    step = 0
    for i in range(out.shape[1]):
        while steps[step, SAMPLE] == i:
            if commanded:
                held = sent[int(steps[step, HELD]), 1 + column]
            f0, f1, away, speed = steps[step, F0], steps[step, F1], value - held, rate
            value = held + f0 * away + f1 * speed
            rate = f0 * speed + f1 * (-stiffness * away - friction * speed)
            step += 1
        out[k, i, column] = value


@entry(array(1), array(2), array(2), array(2), array(3))
def respond(times: Array, sent: Array, parameters: Array, steps: Array, out: Array) -> int:
    """The responses with each of the `parameters` (K, 3) at `times` (N,) to piecewise constant
    commands, `sent` (M, 1 + axes), at rest on the command in force at the start. `out` (K, N, at
    least axes + 2): the axes, then the free responses to a unit offset and to a unit rate. Rows in
    the order of time; exact. `steps` (N + M + 1, 4) is scratch."""
    for k in range(parameters.shape[0]):
        _divide(k, times, sent, parameters, steps)
        for column in range(sent.shape[1] + 1):
            _follow(k, column, sent, parameters, steps, out)
    return 0


class Data:
    """Signals (N, axes) at `times` (N,) under commands: `sent` (M, 1 + axes), when and what; each
    contiguous and in the order of time."""

    def __init__(self, times: Array, signals: Array, sent: Array) -> None:
        self.times, self.signals, self._sent = times, signals, sent
        self._steps = np.empty((len(times) + len(sent) + 1, 4))
        self._sought: dict[int, _Sought] = {}

    def responses(self, parameters: Array) -> Array:
        """`respond` with `parameters` (K, 3), and a constant: (K, N, axes + 3), which the next call
        for as many writes over."""
        count = len(parameters)
        sought = self._sought.get(count)
        if sought is None:
            sought = self._sought[count] = self._bound(count)
        sought.parameters[:] = parameters
        sought.respond()
        return sought.out

    def _bound(self, count: int) -> _Sought:
        parameters = np.empty((count, 3))
        out = np.ones((count, len(self.times), self.signals.shape[1] + 3))
        bound = partial(respond, self.times, self._sent, parameters, self._steps, out)
        return _Sought(parameters, bound, out)


@dataclass(frozen=True, slots=True)
class _Sought:
    """So many responses at once: what is written, called and read."""

    parameters: Array
    respond: Callable[[], int]
    out: Array


def residuals(data: Data, parameters: Array, weights: Array) -> Array:
    """Signals less the responses with each of the `parameters` (K, 3), free motion and a constant
    offset projected out under `weights` (N,): (K, N, axes)."""
    axes = data.signals.shape[1]
    out = data.responses(parameters)
    left: Array = data.signals - out[:, :, :axes]
    basis = out[:, :, axes:]
    weighted = basis.swapaxes(1, 2) * weights
    gram = weighted @ basis
    diagonal = np.einsum("kii->ki", gram)
    diagonal += 1e-12 + 1e-9 * diagonal
    left -= basis @ np.linalg.solve(gram, weighted @ left)
    return left


def residual(data: Data, parameters: Array, weights: Array) -> Array:
    """`residuals` (N, axes) with one set of `parameters` (3,)."""
    left: Array = residuals(data, parameters[None], weights)[0]
    return left


def scale_of(left: Array) -> float:
    """Standard deviation of the bulk."""
    return max(float(np.median(np.abs(left))) / 0.6745, LEAST_SCALE)


def weights_of(left: Array, scale: float) -> Array:
    """Weights (N,) of Student's t, one for all axes of a sample."""
    far = (left**2).sum(axis=1)
    weights: Array = (FREEDOM + left.shape[1]) / (FREEDOM + far / scale**2)
    return weights


def slopes(data: Data, parameters: Array, weights: Array, left: Array) -> Array:
    """Of the residual `left` (N, axes) by the parameters: (3, N, axes)."""
    steps = DIFFERENCE * STEP_SCALES
    steps[parameters + steps > UPPER] *= -1.0
    slope: Array = residuals(data, parameters + np.diag(steps), weights) - left
    slope /= steps[:, None, None]
    return slope


def _cost(left: Array, weights: Array) -> float:
    return float(weights @ (left**2).sum(axis=1))


def search(data: Data, start: Array) -> tuple[Array, float]:
    """The parameters (3,) that a damped Gauss-Newton search from `start` ends at, and the
    negative log likelihood there."""
    weights = np.ones(len(data.times))
    best, damping = start, 1e-3
    left = residual(data, best, weights)
    for step in range(STEPS):
        if step >= PLAIN_STEPS:
            weights = weights_of(left, scale_of(left))
            left = residual(data, best, weights)
        tried, left, damping = _descend(data, best, weights, left, damping)
        moved = np.max(np.abs(tried - best) / STEP_SCALES)
        best = tried
        if moved < CONVERGED and step >= PLAIN_STEPS:
            break
    scale = scale_of(left)
    far = (left**2).sum(axis=1)
    unlikely = left.size * math.log(scale)
    unlikely += 0.5 * (FREEDOM + left.shape[1]) * np.sum(np.log1p(far / (FREEDOM * scale**2)))
    return best, float(unlikely)


def _descend(
    data: Data, best: Array, weights: Array, left: Array, damping: float
) -> tuple[Array, Array, float]:
    """One step from `best`, where `left` is the residual: the parameters and the residual behind
    it, the same if none is better, and the damping of the next."""
    cost = _cost(left, weights)
    slope = slopes(data, best, weights, left).reshape(3, -1) * STEP_SCALES[:, None]
    weighted = slope * np.repeat(weights, left.shape[1])
    normal, gradient = weighted @ slope.T, weighted @ left.ravel()
    for _ in range(DESCENTS):
        damped = normal + np.diag(damping * np.diag(normal) + 1e-12)
        tried = best - np.linalg.solve(damped, gradient) * STEP_SCALES
        tried = np.minimum(np.maximum(tried, LOWER), UPPER)
        tried_left = residual(data, tried, weights)
        if _cost(tried_left, weights) < cost:
            return tried, tried_left, max(0.1 * damping, 1e-7)
        damping *= 10.0
    return best, left, damping
