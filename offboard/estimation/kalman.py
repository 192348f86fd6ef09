"""Kalman filters with a few states, compiled: prediction of the covariance, update, and the noise.

    predict   P <- F P F' + Q              over any interval between two messages
    update    S = H P H' + R,  K = P H' / S,  x <- x + K (z - H x),  P <- P - K S K'

Axes with the same model share one covariance, as north and east do: `places` has, for each axis,
the indices of the filter's states in the observer's state x. One measurement is used after the
other, so S is a number. Records and states are changed in place. Loops over single numbers, because
array expressions compile for seconds.

R and Q are estimated as well (R. Mehra, 1970: with the right ones innovations are white).
Innovations that change sign from one message to the next show that the measurement is noisier than
configured. Innovations correlated over a fifth of a second show a disturbance that drifts faster
than configured (gusts); the estimators of PX4 and ArduCopter drift too, but their innovations are
correlated for less. Both estimates are slow, bounded, and never below the configured values.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import array, entry, kernel

Array = NDArray[np.float64]

SIZE_MAX, AXES_MAX = 6, 2
AT_POSITION, AT_VELOCITY, AT_ATTITUDE = 0, 1, 2  # rows of H

FILTER = np.dtype(
    [
        ("order", "i8"),  # n, the number of states in use
        ("axes", "i8"),  # the number of axes in use
        ("places", "i8", (AXES_MAX, SIZE_MAX)),
        ("dynamics", "f8", (SIZE_MAX, SIZE_MAX)),  # of x' = dynamics x: F = exp(dynamics h)
        ("densities", "f8", SIZE_MAX),  # of the process noise, per root second
        ("measures", "f8", (3, SIZE_MAX)),  # H
        ("covariance", "f8", (SIZE_MAX, SIZE_MAX)),  # P
        # of the last measurement, and scratch
        ("innovation", "f8", AXES_MAX),
        ("projected", "f8", SIZE_MAX),  # P H'
        ("gain", "f8", SIZE_MAX),  # K
        ("work", "f8", (4, SIZE_MAX, SIZE_MAX)),
    ],
    align=True,
)
"""A filter of n states for one or two axes."""


@kernel
def _multiply(left: Array, right: Array, size: int, out: Array) -> None:
    """out = left @ right for matrices of `size`; compiles in a tenth of the time of `@`."""
    for i in range(size):
        for j in range(size):
            total = 0.0
            for k in range(size):
                total += left[i, k] * right[k, j]
            out[i, j] = total


@entry(array(1, FILTER), float, float)
def predict(filters: Any, interval_s: float, longest_s: float) -> None:
    """Propagate the covariances of `filters` by `interval_s`, in steps of at most `longest_s`."""
    steps = math.ceil(interval_s / longest_s - 1e-6)
    if steps <= 0:
        return
    step_s = interval_s / steps
    for n in range(filters.shape[0]):
        one = filters[n]
        order, covariance, densities = one.order, one.covariance[:], one.densities[:]
        half, transition, noise, moved = one.work[0], one.work[1], one.work[2], one.work[3]
        # F = exp(dynamics step_s / 2) to fourth order, squared
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
        # Q by Simpson's rule, exact for a chain of two integrators
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
def innovation_variance(one: Any, row: int, variance: float) -> float:
    """S = H P H' + `variance` of the measurement in `row` of H; P H' is left in `projected`."""
    total = variance
    for i in range(one.order):
        one.projected[i] = 0.0
        for j in range(one.order):
            one.projected[i] += one.covariance[i, j] * one.measures[row, j]
    for i in range(one.order):
        total += one.measures[row, i] * one.projected[i]
    return total


@kernel
def update(state: Array, one: Any, row: int, variance: float) -> None:
    """Update state and covariance by the measurement in `row` of H with noise of `variance`, whose
    `innovation` z - H x is in the record."""
    total = innovation_variance(one, row, variance)
    covariance, gain, projected = one.covariance, one.gain, one.projected
    for i in range(one.order):
        gain[i] = projected[i] / total
    for i in range(one.order):
        for j in range(i + 1):
            value = covariance[i, j] - 0.5 * (gain[i] * projected[j] + gain[j] * projected[i])
            covariance[i, j] = covariance[j, i] = value
    for axis in range(one.axes):
        for i in range(one.order):
            state[one.places[axis, i]] += gain[i] * one.innovation[axis]


@kernel
def reset_position(state: Array, one: Any, measured: Array, variance: float) -> None:
    """After a jump of the position: take it as `measured` and leave the other states."""
    for axis in range(one.axes):
        state[one.places[axis, 0]] = measured[one.places[axis, 0]]
    for i in range(one.order):
        one.covariance[0, i] = one.covariance[i, 0] = 0.0
    one.covariance[0, 0] = variance


@kernel
def reset_bias(state: Array, one: Any, variance: float) -> None:
    """After a jump of the reported velocity: add it to the bias, the last state."""
    bias = one.order - 1
    covariance = one.covariance
    for axis in range(one.axes):
        state[one.places[axis, bias]] += one.innovation[axis]
    for i in range(one.order):
        covariance[bias, i] = -covariance[1, i]
    for i in range(one.order):
        covariance[i, bias] = covariance[bias, i]
    covariance[bias, bias] = covariance[1, 1] + variance


# ---------------------------------------------------------------------- R and Q from innovations

NOISE_TIME_S = 3.0
NOISE_OUTLIER = 25.0  # limit of a single product, in variances
# Innovations are averaged over SPAN_S and correlated with those two spans earlier.
SPAN_S, LONGEST_SPAN_S, DRIFT_TIME_S = 0.1, 0.3, 3.0
CORRELATED = 0.25  # correlation above which the density grows, by e per second for each 1 above
VISIBLE_M = 5e-5  # smaller innovations do not count
LATERAL, VERTICAL = 0, 1

ADAPTATION = np.dtype(
    [
        ("least", "f8", 2),  # noise variances of position and velocity, configured
        ("variance", "f8", 2),  # the same, estimated
        ("bounds", "f8", (2, 2)),  # least and greatest drift density, lateral and vertical
        ("density", "f8", 2),  # the same, estimated
        # of the last message: position (m) and velocity (m/s), NED
        ("innovation", "f8", 6),  # measured less predicted
        ("residual", "f8", 6),  # measured less updated
        ("change", "f8", 6),  # innovation less the residual of the message before
        # of spans: innovations of the present one, and the means of the last three, newest first
        ("total", "f8", 6),
        ("means", "f8", (3, 6)),
        ("product", "f8", 2),  # mean product of means two spans apart, lateral and vertical
        ("square", "f8", 2),  # their mean square
        ("began_s", "f8"),
        ("last_s", "f8"),  # time of the last message
        ("messages", "i8"),  # in the present span
        ("in_a_row", "i8"),  # messages without an interruption
        ("spans", "i8"),  # ended without an interruption
    ],
    align=True,
)
"""Noise R and drift Q as estimated, and the sums that they are estimated from."""


@kernel
def measurement_variance(noted: Any, kind: int) -> float:
    """R of the position (`kind` 0, m^2) or the velocity (1, m^2/s^2)."""
    variance: float = max(noted.variance[kind], noted.least[kind])
    return variance


@kernel
def interrupt(noted: Any) -> None:
    """Do not correlate the next innovation with the last one: after a jump, a gap or a restart."""
    for i in range(6):
        noted.total[i] = 0.0
    noted.messages = noted.in_a_row = noted.spans = 0


@kernel
def _estimate_noise(noted: Any, interval_s: float, residual: Array) -> None:
    """The measured change since the last message less the predicted one is innovation - residual.
    For white noise of variance s^2, successive changes have the covariance -s^2; for a measurement
    whose error drifts, they have none."""
    share = min(interval_s / NOISE_TIME_S, 0.1)
    for kind in range(2):
        product = 0.0
        for i in range(3 * kind, 3 * kind + 3):
            product -= (noted.innovation[i] - residual[i]) * noted.change[i] / 3.0
        limit = NOISE_OUTLIER * measurement_variance(noted, kind)
        product = min(max(product, -limit), limit)
        noted.variance[kind] += share * (product - noted.variance[kind])


@kernel
def _estimate_drift(noted: Any, span_s: float) -> None:
    """Update the drift densities, lateral and vertical, from the means of three spans."""
    share = span_s / DRIFT_TIME_S
    for group in range(2):
        product, square = 0.0, 0.0
        first, end = (0, 2) if group == LATERAL else (2, 3)
        for axis in range(first, end):
            now, before = noted.means[0, axis], noted.means[2, axis]
            product += now * before / (end - first)
            square += 0.5 * (now**2 + before**2) / (end - first)
        noted.product[group] += share * (product - noted.product[group])
        noted.square[group] += share * (square - noted.square[group])
        correlation = noted.product[group] / (noted.square[group] + VISIBLE_M**2)
        grown = noted.density[group] * math.exp(span_s * (correlation - CORRELATED))
        noted.density[group] = min(max(grown, noted.bounds[group, 0]), noted.bounds[group, 1])


@kernel
def adapt(noted: Any, time_s: float, residual: Array) -> None:
    """Estimate R and Q anew from one message: `innovation` is in the record, `residual` (6,) is the
    same after the update."""
    if noted.in_a_row == 0:
        noted.began_s = time_s
    elif noted.in_a_row > 1:
        _estimate_noise(noted, time_s - noted.last_s, noted.residual[:])
    for i in range(6):
        noted.change[i] = noted.innovation[i] - noted.residual[i]
        noted.residual[i] = residual[i]
        noted.total[i] += noted.innovation[i]
    noted.messages += 1
    noted.in_a_row += 1
    noted.last_s = time_s
    span_s = time_s - noted.began_s
    if span_s < SPAN_S - 1e-6:
        return
    for i in range(6):
        noted.means[2, i], noted.means[1, i] = noted.means[1, i], noted.means[0, i]
        noted.means[0, i] = noted.total[i] / noted.messages
        noted.total[i] = 0.0
    noted.messages, noted.began_s = 0, time_s
    noted.spans += 1
    if noted.spans > 2:
        _estimate_drift(noted, min(span_s, LONGEST_SPAN_S))
