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
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.model.kernel import array, entry, kernel

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


@dataclass(frozen=True, slots=True)
class Data:
    """Signals (N, axes) at `times` (N,) under commands: `sent` (M, 1 + axes), when and what; each
    contiguous and in the order of time."""

    times: Array
    signals: Array
    sent: Array


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


@entry(array(1), array(2), array(2), array(2), array(3))
def respond(times: Array, sent: Array, parameters: Array, motion: Array, out: Array) -> int:
    """The responses with each of the `parameters` (K, 3) at `times` (N,) to piecewise constant
    commands, `sent` (M, 1 + axes), at rest on the command in force at the start. `out` (K, N, at
    least axes + 2): the axes, then the free responses to a unit offset and to a unit rate. Rows in
    the order of time; exact. `motion` (2, axes + 2) is scratch."""
    for k in range(parameters.shape[0]):
        _follow(times, sent, parameters[k], motion, out[k])
    return 0


@kernel
def _follow(times: Array, sent: Array, parameters: Array, motion: Array, out: Array) -> None:
    delay_s, frequency, damping = parameters[0], parameters[1], parameters[2]
    axes = sent.shape[1] - 1
    value, rate = motion[0], motion[1]
    now = times[0]
    row = -1
    while row + 1 < sent.shape[0] and sent[row + 1, 0] + delay_s <= now:
        row += 1
    for axis in range(axes):
        value[axis], rate[axis] = sent[max(row, 0), 1 + axis], 0.0
    value[axes], rate[axes] = 1.0, 0.0
    value[axes + 1], rate[axes + 1] = 0.0, 1.0
    stiffness, friction = frequency * frequency, 2.0 * damping * frequency
    for i in range(times.shape[0]):
        while now < times[i]:
            until = times[i]
            following = row + 1
            acts = following < sent.shape[0] and sent[following, 0] + delay_s <= until
            if acts:
                until = max(sent[following, 0] + delay_s, now)
            f0, f1 = _propagator(frequency, damping, until - now)
            for axis in range(axes + 2):
                held = sent[max(row, 0), 1 + axis] if axis < axes else 0.0
                away, speed = value[axis] - held, rate[axis]
                value[axis] = held + f0 * away + f1 * speed
                rate[axis] = f0 * speed + f1 * (-stiffness * away - friction * speed)
            now = until
            if acts:
                row = following
            elif until >= times[i]:
                break
        for axis in range(axes + 2):
            out[i, axis] = value[axis]


def residuals(data: Data, parameters: Array, weights: Array) -> Array:
    """Signals less the responses with each of the `parameters` (K, 3), free motion and a constant
    offset projected out under `weights` (N,): (K, N, axes)."""
    axes = data.signals.shape[1]
    motion = np.empty((2, axes + 2))
    out = np.ones((len(parameters), len(data.times), axes + 3))
    respond.call(data.times, data.sent, parameters, motion, out)
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
    far = np.sum(left**2, axis=1)
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
    return float(weights @ np.sum(left**2, axis=1))


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
    far = np.sum(left**2, axis=1)
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
        tried = np.clip(best - np.linalg.solve(damped, gradient) * STEP_SCALES, LOWER, UPPER)
        tried_left = residual(data, tried, weights)
        if _cost(tried_left, weights) < cost:
            return tried, tried_left, max(0.1 * damping, 1e-7)
        damping *= 10.0
    return best, left, damping
