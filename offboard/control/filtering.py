"""The observer's small Kalman filters, compiled: covariances and what a measurement corrects.

Covariances are propagated for the actual interval between messages, so no sampling rate is
assumed. Axes with the same model share one covariance (both lateral axes do): `places` (m, n)
tells for each of m axes where its n filter states stand in the observer's state vector. Their
order is position, velocity, ..., bias of the reported velocity, or b and b', or psi and psi'.
Arrays are changed in place. Nothing here knows messages, settings or the motion itself. Loops over
single numbers throughout: array expressions of so few compile for seconds.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Places = NDArray[np.int64]

GATE_SDS = 3.0


@numba.njit(cache=True)
def _product(left: Array, right: Array) -> Array:
    """left @ right, both (n, n): small matrices, and a tenth of the time to compile."""
    size = len(left)
    out = np.empty((size, size))
    for i in range(size):
        for j in range(size):
            total = 0.0
            for k in range(size):
                total += left[i, k] * right[k, j]
            out[i, j] = total
    return out


@numba.njit(cache=True)
def _transition(dynamics: Array, interval_s: float) -> Array:
    """exp(dynamics interval_s), (n, n), to fourth order."""
    size = len(dynamics)
    scaled = np.empty((size, size))
    for i in range(size):
        for j in range(size):
            scaled[i, j] = interval_s * dynamics[i, j]
    square = _product(scaled, scaled)
    cube = _product(square, scaled)
    fourth = _product(square, square)
    for i in range(size):
        for j in range(size):
            scaled[i, j] += square[i, j] / 2.0 + cube[i, j] / 6.0 + fourth[i, j] / 24.0
        scaled[i, i] += 1.0
    return scaled


@numba.njit(cache=True)
def spread(
    covariance: Array, dynamics: Array, densities: Array, interval_s: float, longest_s: float
) -> None:
    """Covariance (n, n) over `interval_s`: P' = F P + P F' + diag(densities^2).

    dynamics F (n, n); densities (n,) per root second; steps of at most `longest_s`.
    """
    steps = math.ceil(interval_s / longest_s - 1e-6)
    if steps <= 0:
        return
    h = interval_s / steps
    half = _transition(dynamics, 0.5 * h)
    transition = _product(half, half)
    noise = _noise(half, transition, densities, h)
    size = len(covariance)
    for _ in range(steps):
        moved = _product(transition, covariance)
        for i in range(size):
            for j in range(size):
                total = noise[i, j]
                for k in range(size):
                    total += moved[i, k] * transition[j, k]
                covariance[i, j] = total


@numba.njit(cache=True)
def _noise(half: Array, transition: Array, densities: Array, interval_s: float) -> Array:
    """What the densities add to a covariance, by Simpson's rule: exact for a chain of two
    integrators."""
    size = len(half)
    noise = np.empty((size, size))
    for i in range(size):
        for j in range(size):
            total = densities[i] ** 2 if i == j else 0.0
            for k in range(size):
                middle, end = half[i, k] * half[j, k], transition[i, k] * transition[j, k]
                total += densities[k] ** 2 * (4.0 * middle + end)
            noise[i, j] = total * interval_s / 6.0
    return noise


@numba.njit(cache=True)
def _projected(covariance: Array, row: Array) -> Array:
    """covariance (n, n) @ row (n,)."""
    size = len(row)
    out = np.empty(size)
    for i in range(size):
        total = 0.0
        for k in range(size):
            total += covariance[i, k] * row[k]
        out[i] = total
    return out


@numba.njit(cache=True)
def absorb(covariance: Array, row: Array, variance: float) -> Array:
    """Scalar measurement row @ x with the given variance: updates the covariance (n, n) and
    returns the gain (n,)."""
    projected = _projected(covariance, row)
    size = len(row)
    total = variance
    for i in range(size):
        total += row[i] * projected[i]
    gain = np.empty(size)
    for i in range(size):
        gain[i] = projected[i] / total
    for i in range(size):
        for j in range(i + 1):
            value = covariance[i, j] - 0.5 * (gain[i] * projected[j] + gain[j] * projected[i])
            covariance[i, j] = value
            covariance[j, i] = value
    return gain


@numba.njit(cache=True)
def correct(
    state: Array, places: Places, covariance: Array, row: Array, innovation: Array, sd: float
) -> None:
    """One scalar measurement row @ x per axis, innovation (m,), standard deviation `sd`."""
    gain = absorb(covariance, row, sd * sd)
    for k in range(len(places)):
        for i in range(len(row)):
            state[places[k, i]] += gain[i] * innovation[k]


@numba.njit(cache=True)
def _jumped(covariance: Array, row: Array, innovation: Array, sd: float, gate: float) -> bool:
    projected = _projected(covariance, row)
    variance = sd * sd
    for i in range(len(row)):
        variance += row[i] * projected[i]
    largest = 0.0
    for value in innovation:
        largest = max(largest, abs(value))
    return largest > gate + GATE_SDS * math.sqrt(variance)


@numba.njit(cache=True)
def correct_position(
    state: Array, places: Places, covariance: Array, measured: Array, sd: float, gate: float
) -> int:
    """Position (m,) of a group of axes. Further off than `gate` beyond the expected spread it is
    a jump of the estimate: the position is re-anchored and nothing else moves.

    Returns the number of jumps, 0 or 1.
    """
    row = np.zeros(len(covariance))
    row[0] = 1.0
    innovation = np.empty(len(places))
    for k in range(len(places)):
        innovation[k] = measured[k] - state[places[k, 0]]
    if not _jumped(covariance, row, innovation, sd, gate):
        correct(state, places, covariance, row, innovation, sd)
        return 0
    for k in range(len(places)):
        state[places[k, 0]] = measured[k]
    for i in range(len(covariance)):
        covariance[0, i] = covariance[i, 0] = 0.0
    covariance[0, 0] = sd * sd
    return 1


@numba.njit(cache=True)
def correct_velocity(
    state: Array, places: Places, covariance: Array, measured: Array, sd: float, gate: float
) -> int:
    """Reported velocity (m,) = velocity + bias. A jump (as in `correct_position`) goes into the
    bias. Returns the number of jumps, 0 or 1."""
    bias = len(covariance) - 1
    row = np.zeros(len(covariance))
    row[1] = 1.0
    row[bias] = 1.0
    innovation = np.empty(len(places))
    for k in range(len(places)):
        innovation[k] = measured[k] - state[places[k, 1]] - state[places[k, bias]]
    if not _jumped(covariance, row, innovation, sd, gate):
        correct(state, places, covariance, row, innovation, sd)
        return 0
    for k in range(len(places)):
        state[places[k, bias]] += innovation[k]
    for i in range(len(covariance)):
        covariance[bias, i] = -covariance[1, i]
    for i in range(len(covariance)):
        covariance[i, bias] = covariance[bias, i]
    covariance[bias, bias] = covariance[1, 1] + sd * sd
    return 1
