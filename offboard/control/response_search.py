"""The response of a second-order loop to commands held between events, and the search for its
three parameters: compiled, with a bounded number of steps, so that it takes some milliseconds.

The command is constant from one event to the next, so the response is followed exactly; its
unknown start and offset are projected out. A link loses commands, and what follows a lost one
tells of no response: residuals are taken for Student's t, so that they weigh less the larger they
are (K. Lange, R. Little and J. Taylor, 1989). Times in s, signals in any unit; knows arrays only.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DELAY, FREQUENCY, DAMPING = 0, 1, 2
LOWER = np.array([0.0, 0.5, 0.1])
UPPER = np.array([0.5, 60.0, 3.0])
FREEDOM = 3.0  # of Student's t
LEAST_SCALE = 2e-4  # of residuals: below it all weigh the same
PLAIN_STEPS, STEPS, DESCENTS = 4, 14, 6  # unweighted at first; of one search; tries of one step
STEP_SCALES = np.array([0.03, 5.0, 0.3])
HALVINGS = 30  # of the range in which a median is sought
CONVERGED = 2e-4  # of STEP_SCALES
DIFFERENCE = 1e-3  # of them too, for slopes


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


@numba.njit(cache=True)
def _solve(matrix: Array, right: Array) -> None:
    """In place: `right` (n, m) becomes the solution, for a positive definite `matrix` (n, n).
    Elimination written out: numba's solver compiles for five seconds."""
    size, width = right.shape
    for pivot in range(size):
        for row in range(pivot + 1, size):
            share = matrix[row, pivot] / matrix[pivot, pivot]
            for column in range(pivot, size):
                matrix[row, column] -= share * matrix[pivot, column]
            for column in range(width):
                right[row, column] -= share * right[pivot, column]
    for row in range(size - 1, -1, -1):
        for column in range(width):
            total = right[row, column]
            for k in range(row + 1, size):
                total -= matrix[row, k] * right[k, column]
            right[row, column] = total / matrix[row, row]


@numba.njit(cache=True)
def residual(
    times: Array,
    signals: Array,
    sent_at: Array,
    commands: Array,
    parameters: Array,
    weights: Array,
    out: Array,
    left: Array,
) -> None:
    """Signals less response into `left` (N, axes), free motion and a constant offset projected out
    under `weights` (N,); `out` (N, axes + 2) as in `respond`."""
    count, axes = signals.shape
    respond(times, sent_at, commands, parameters[0], parameters[1], parameters[2], out)
    gram = np.zeros((3, 3))
    reach = np.zeros((3, axes))
    basis = np.ones(3)
    for i in range(count):
        basis[0], basis[1] = out[i, axes], out[i, axes + 1]
        for axis in range(axes):
            left[i, axis] = signals[i, axis] - out[i, axis]
        for j in range(3):
            for k in range(3):
                gram[j, k] += weights[i] * basis[j] * basis[k]
            for axis in range(axes):
                reach[j, axis] += weights[i] * basis[j] * left[i, axis]
    for j in range(3):
        gram[j, j] += 1e-12 + 1e-9 * gram[j, j]
    _solve(gram, reach)
    for i in range(count):
        for axis in range(axes):
            left[i, axis] -= (
                out[i, axes] * reach[0, axis] + out[i, axes + 1] * reach[1, axis] + reach[2, axis]
            )


@numba.njit(cache=True)
def scale_of(left: Array) -> float:
    """Standard deviation of the bulk: the median size, halved into, over 0.6745."""
    low, high = 0.0, 0.0
    for i in range(left.shape[0]):
        for axis in range(left.shape[1]):
            high = max(high, abs(left[i, axis]))
    for _ in range(HALVINGS):
        middle, below = 0.5 * (low + high), 0
        for i in range(left.shape[0]):
            for axis in range(left.shape[1]):
                below += abs(left[i, axis]) <= middle
        if 2 * below >= left.size:
            high = middle
        else:
            low = middle
    return max(high / 0.6745, LEAST_SCALE)


@numba.njit(cache=True)
def weigh(left: Array, scale: float, weights: Array) -> None:
    """Weights of Student's t, one for all axes of a sample."""
    axes = left.shape[1]
    for i in range(left.shape[0]):
        far = 0.0
        for axis in range(axes):
            far += left[i, axis] ** 2
        weights[i] = (FREEDOM + axes) / (FREEDOM + far / scale**2)


@numba.njit(cache=True)
def _cost(left: Array, weights: Array) -> float:
    total = 0.0
    for i in range(left.shape[0]):
        for axis in range(left.shape[1]):
            total += weights[i] * left[i, axis] ** 2
    return total


@numba.njit(cache=True)
def slopes(
    times: Array,
    signals: Array,
    sent_at: Array,
    commands: Array,
    parameters: Array,
    weights: Array,
    left: Array,
    out: Array,
) -> Array:
    """Of the residual `left` (N, axes) by the parameters: (3, N, axes)."""
    slope = np.empty((3, *left.shape))
    for j in range(3):
        moved = parameters.copy()
        step = DIFFERENCE * STEP_SCALES[j]
        if moved[j] + step > UPPER[j]:
            step = -step
        moved[j] += step
        residual(times, signals, sent_at, commands, moved, weights, out, slope[j])
        for i in range(left.shape[0]):
            for axis in range(left.shape[1]):
                slope[j, i, axis] = (slope[j, i, axis] - left[i, axis]) / step
    return slope


@numba.njit(cache=True)
def _normal(slope: Array, left: Array, weights: Array) -> tuple[Array, Array]:
    """Normal matrix (3, 3) and gradient (3, 1), in units of STEP_SCALES."""
    normal, gradient = np.zeros((3, 3)), np.zeros((3, 1))
    row = np.empty(3)
    for i in range(left.shape[0]):
        for axis in range(left.shape[1]):
            for j in range(3):
                row[j] = slope[j, i, axis] * STEP_SCALES[j]
            for j in range(3):
                gradient[j, 0] += weights[i] * row[j] * left[i, axis]
                for k in range(3):
                    normal[j, k] += weights[i] * row[j] * row[k]
    return normal, gradient


@numba.njit(cache=True)
def search(
    times: Array, signals: Array, sent_at: Array, commands: Array, start: Array
) -> tuple[Array, float]:
    """The parameters (3,) that a damped Gauss-Newton search from `start` ends at, and the
    negative log likelihood there."""
    count, axes = signals.shape
    weights = np.ones(count)
    out = np.empty((count, axes + 2))
    left, tried_left = np.empty((count, axes)), np.empty((count, axes))
    best, tried = start.copy(), start.copy()
    damping = 1e-3
    residual(times, signals, sent_at, commands, best, weights, out, left)
    for step in range(STEPS):
        if step >= PLAIN_STEPS:
            weigh(left, scale_of(left), weights)
            residual(times, signals, sent_at, commands, best, weights, out, left)
        cost = _cost(left, weights)
        slope = slopes(times, signals, sent_at, commands, best, weights, left, out)
        normal, gradient = _normal(slope, left, weights)
        moved = 0.0
        for _ in range(DESCENTS):
            damped = normal.copy()
            for j in range(3):
                damped[j, j] += damping * normal[j, j] + 1e-12
            change = gradient.copy()
            _solve(damped, change)
            for j in range(3):
                aim = best[j] - change[j, 0] * STEP_SCALES[j]
                tried[j] = min(max(aim, LOWER[j]), UPPER[j])
            residual(times, signals, sent_at, commands, tried, weights, out, tried_left)
            if _cost(tried_left, weights) < cost:
                for j in range(3):
                    moved = max(moved, abs(tried[j] - best[j]) / STEP_SCALES[j])
                    best[j] = tried[j]
                left, tried_left = tried_left, left
                damping = max(0.1 * damping, 1e-7)
                break
            damping *= 10.0
        if moved < CONVERGED and step >= PLAIN_STEPS:
            break
    scale = scale_of(left)
    unlikely = count * axes * math.log(scale)
    for i in range(count):
        far = 0.0
        for axis in range(axes):
            far += left[i, axis] ** 2
        unlikely += 0.5 * (FREEDOM + axes) * math.log(1.0 + far / (FREEDOM * scale**2))
    return best, unlikely
