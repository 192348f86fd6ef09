"""Small Kalman filters of the observer, compiled: covariances and corrections.

Covariances are propagated over the actual interval between messages, so no sampling rate is
assumed. Axes with the same model share one filter, as both lateral axes do: `places` has, for each
axis, the indices of the filter's states in the state vector that it corrects. The states are
position, velocity, ..., bias of the reported velocity, or b and b', or psi and psi'. Records and
states are changed in place. Loops over single numbers, because array expressions compile for
seconds.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offboard.compiled import array, entry, kernel

Array = NDArray[np.float64]

GATE_SDS = 3.0
SIZE_MAX, AXES_MAX = 6, 2
NOTHING = -1  # the measurement is of one state, not of the sum of two

FILTER = np.dtype(
    [
        ("order", "i8"),  # n, the number of states in use
        ("axes", "i8"),  # m, the number of axes in use
        ("places", "i8", (AXES_MAX, SIZE_MAX)),
        ("covariance", "f8", (SIZE_MAX, SIZE_MAX)),
        ("dynamics", "f8", (SIZE_MAX, SIZE_MAX)),
        ("densities", "f8", SIZE_MAX),  # per root second
        ("longest_s", "f8"),  # longest step of propagation
        # scratch; `gain` is that of the last measurement
        ("gain", "f8", SIZE_MAX),
        ("projected", "f8", SIZE_MAX),
        ("innovation", "f8", AXES_MAX),
        ("work", "f8", (4, SIZE_MAX, SIZE_MAX)),
    ],
    align=True,
)
"""One filter of n states for m axes: x' = F x, P' = F P + P F' + diag(densities^2)."""


def set_up(one: Any, dynamics: Array, densities: Array) -> None:
    """Set the model of a FILTER: `dynamics` (n, n), `densities` (n,) per root second."""
    order = len(densities)
    one["order"] = order
    one["dynamics"][:order, :order] = dynamics
    one["densities"][:order] = densities


def start(one: Any, variances: ArrayLike) -> None:
    """Start a FILTER with uncorrelated errors of `variances` (n,)."""
    covariance = np.diag(variances)
    one["covariance"][: len(covariance), : len(covariance)] = covariance


@kernel
def _multiply(left: Array, right: Array, size: int, out: Array) -> None:
    """out = left @ right for matrices of `size`; compiles in a tenth of the time of `@`."""
    for i in range(size):
        for j in range(size):
            total = 0.0
            for k in range(size):
                total += left[i, k] * right[k, j]
            out[i, j] = total


@entry(array(1, FILTER), float)
def spread(filters: Any, interval_s: float) -> None:
    """Propagate the covariances of `filters` (FILTER, any number) by `interval_s`, in steps of at
    most `longest_s`.

    One function, because each further one takes a fifth of a second to compile.
    """
    for n in range(filters.shape[0]):
        one = filters[n]
        steps = math.ceil(interval_s / one.longest_s - 1e-6)
        if steps <= 0:
            continue
        step_s = interval_s / steps
        order, covariance, densities = one.order, one.covariance[:], one.densities[:]
        half, transition, noise, moved = one.work[0], one.work[1], one.work[2], one.work[3]
        # exp(dynamics step_s / 2) to fourth order, and its square
        for i in range(order):
            for j in range(order):
                half[i, j] = 0.5 * step_s * one.dynamics[i, j]
        _multiply(half, half, order, transition)
        _multiply(transition, half, order, noise)
        _multiply(transition, transition, order, moved)
        for i in range(order):
            for j in range(order):
                half[i, j] += transition[i, j] / 2.0 + noise[i, j] / 6.0 + moved[i, j] / 24.0
            half[i, i] += 1.0
        _multiply(half, half, order, transition)
        # Process noise by Simpson's rule, exact for a chain of two integrators
        for i in range(order):
            for j in range(order):
                total = densities[i] ** 2 if i == j else 0.0
                for k in range(order):
                    middle, end = half[i, k] * half[j, k], transition[i, k] * transition[j, k]
                    total += densities[k] ** 2 * (4.0 * middle + end)
                noise[i, j] = total * step_s / 6.0
        for _ in range(steps):
            _multiply(transition, covariance, order, moved)
            for i in range(order):
                for j in range(order):
                    total = noise[i, j]
                    for k in range(order):
                        total += moved[i, k] * transition[j, k]
                    covariance[i, j] = total


@kernel
def _expect(one: Any, place: int, other: int, variance: float) -> float:
    """Fill `projected` with the covariance of each state with the measured sum of the states
    `place` and `other` (or NOTHING). Returns the variance of the innovation, of which `variance` is
    the measurement noise."""
    projected = one.projected
    for i in range(one.order):
        projected[i] = one.covariance[i, place]
        if other != NOTHING:
            projected[i] += one.covariance[i, other]
    total: float = variance + projected[place]
    return total if other == NOTHING else total + projected[other]


@kernel
def absorb(one: Any, place: int, other: int, variance: float) -> None:
    """Correct the covariance by a measurement of the sum of the states `place` and `other` (or
    NOTHING), with noise of `variance`; the gain is left in `gain`."""
    covariance, gain, projected = one.covariance, one.gain, one.projected
    total = _expect(one, place, other, variance)
    for i in range(one.order):
        gain[i] = projected[i] / total
    for i in range(one.order):
        for j in range(i + 1):
            value = covariance[i, j] - 0.5 * (gain[i] * projected[j] + gain[j] * projected[i])
            covariance[i, j] = value
            covariance[j, i] = value


@kernel
def correct(state: Array, one: Any, place: int, other: int, sd: float) -> None:
    """Correct covariance and state by a measurement as in `absorb`, whose `innovation` per axis is
    in the record."""
    absorb(one, place, other, sd * sd)
    for k in range(one.axes):
        for i in range(one.order):
            state[one.places[k, i]] += one.gain[i] * one.innovation[k]


@kernel
def correct_within(
    state: Array, one: Any, place: int, other: int, measured: Array, sd: float, gate: float
) -> bool:
    """Correct as in `correct` by `measured`, which has the same indices as `state`. A measurement
    further off than GATE_SDS standard deviations and `gate` is a jump of the vehicle's estimate and
    changes nothing.

    Returns whether the measurement was used.
    """
    largest = 0.0
    for k in range(one.axes):
        seen = one.places[k, place]
        innovation = measured[seen] - state[seen]
        if other != NOTHING:
            innovation -= state[one.places[k, other]]
        one.innovation[k] = innovation
        largest = max(largest, abs(innovation))
    if largest > gate + GATE_SDS * math.sqrt(_expect(one, place, other, sd * sd)):
        return False
    correct(state, one, place, other, sd)
    return True


@kernel
def anchor_position(state: Array, one: Any, measured: Array, sd: float) -> None:
    """After a jump of the position: take it as measured and leave the other states."""
    for k in range(one.axes):
        state[one.places[k, 0]] = measured[one.places[k, 0]]
    for i in range(one.order):
        one.covariance[0, i] = one.covariance[i, 0] = 0.0
    one.covariance[0, 0] = sd * sd


@kernel
def anchor_bias(state: Array, one: Any, sd: float) -> None:
    """After a jump of the reported velocity: add its `innovation` to the bias."""
    bias = one.order - 1
    covariance = one.covariance
    for k in range(one.axes):
        state[one.places[k, bias]] += one.innovation[k]
    for i in range(one.order):
        covariance[bias, i] = -covariance[1, i]
    for i in range(one.order):
        covariance[i, bias] = covariance[bias, i]
    covariance[bias, bias] = covariance[1, 1] + sd * sd
