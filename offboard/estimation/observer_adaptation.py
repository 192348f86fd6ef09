"""Measurement noise and disturbance drift, estimated from the observer's innovations, compiled.

With the right constants innovations are white (R. Mehra, 1970). Innovations that change sign from
one message to the next show that the measurement is noisier than configured. Innovations that are
correlated over a fifth of a second show a disturbance that drifts faster than configured (gusts);
the estimators of PX4 and ArduCopter wander too, but their innovations are shorter. Both estimates
are slow, bounded, and never below the configured values.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import kernel

Array = NDArray[np.float64]

NOISE_TIME_S = 3.0
NOISE_OUTLIER = 25.0  # limit of a single product, in variances
# Innovations are averaged over SPAN_S and correlated with those two spans earlier.
SPAN_S, DRIFT_TIME_S = 0.1, 3.0
RELATED = 0.25  # correlation above which the density grows, by e per second for each 1 above
VISIBLE_M = 5e-5  # smaller innovations do not count
LONGEST_SPAN_S = 0.3
NORTH_EAST, DOWN = 0, 1

# Rows of the memory, six numbers each: position and velocity, NED.
RESIDUAL, CHANGE = 0, 1  # of the last message, see `_weigh`
MEANS = 2  # of the innovations over the last three spans, newest first; position only
RELATION = 5  # mean product (lateral, vertical) and mean square (the same) of the means
SUM = 6  # of the innovations in this span
COUNTS = 7  # messages in this span, messages in a row, spans ended, start of the span, last message
MEMORY_SHAPE = (8, 6)
IN_SPAN, NEIGHBOURS, SPANS, BEGAN_S, LAST_S = 0, 1, 2, 3, 4

ADAPTATION = np.dtype(
    [
        ("memory", "f8", MEMORY_SHAPE),
        ("least", "f8", 2),  # noise variances of position and velocity, configured
        ("variance", "f8", 2),  # the same, estimated
        ("bounds", "f8", (2, 2)),  # least and greatest drift density, lateral and vertical
        ("density", "f8", 2),  # estimated
        # of one message, before and after its correction: position (m) and velocity (m/s), NED
        ("innovation", "f8", 6),
        ("residual", "f8", 6),
    ],
    align=True,
)
"""Estimated noise and drift, and the sums that they are estimated from."""


@kernel
def _weigh(noted: Any, interval_s: float) -> None:
    """Update the noise variances of position and velocity.

    The measured change since the last message less the predicted one is innovation - residual. For
    white noise of variance s^2, successive changes have the covariance -s^2; for a measurement that
    wanders, they have none.
    """
    memory, variance, innovation = noted.memory, noted.variance, noted.innovation
    share = min(interval_s / NOISE_TIME_S, 0.1)
    for kind in range(2):
        product = 0.0
        for i in range(3 * kind, 3 * kind + 3):
            product -= (innovation[i] - memory[RESIDUAL, i]) * memory[CHANGE, i] / 3.0
        limit = NOISE_OUTLIER * max(variance[kind], noted.least[kind])
        product = min(max(product, -limit), limit)
        variance[kind] += share * (product - variance[kind])


@kernel
def _relate(noted: Any, span_s: float) -> None:
    """Update the drift densities, lateral and vertical, from the means of three spans."""
    memory, bounds, density = noted.memory, noted.bounds, noted.density
    share = span_s / DRIFT_TIME_S
    relation = memory[RELATION]
    for group in range(2):
        product, square = 0.0, 0.0
        first, end = (0, 2) if group == NORTH_EAST else (2, 3)
        for axis in range(first, end):
            now, before = memory[MEANS, axis], memory[MEANS + 2, axis]
            product += now * before / (end - first)
            square += 0.5 * (now**2 + before**2) / (end - first)
        relation[group] += share * (product - relation[group])
        relation[2 + group] += share * (square - relation[2 + group])
        correlation = relation[group] / (relation[2 + group] + VISIBLE_M**2)
        grown = density[group] * math.exp(span_s * (correlation - RELATED))
        density[group] = min(max(grown, bounds[group, 0]), bounds[group, 1])


@kernel
def _end_span(memory: Array, time_s: float) -> None:
    counts = memory[COUNTS]
    for i in range(6):
        memory[MEANS + 2, i] = memory[MEANS + 1, i]
        memory[MEANS + 1, i] = memory[MEANS, i]
        memory[MEANS, i] = memory[SUM, i] / counts[IN_SPAN]
        memory[SUM, i] = 0.0
    counts[IN_SPAN] = 0.0
    counts[BEGAN_S] = time_s
    counts[SPANS] += 1.0


@kernel
def note(noted: Any, time_s: float) -> None:
    """Update noise and drift by one message."""
    memory, innovation = noted.memory, noted.innovation
    counts = memory[COUNTS]
    if counts[NEIGHBOURS] == 0.0:
        counts[BEGAN_S] = time_s
    elif counts[NEIGHBOURS] > 1.0:
        _weigh(noted, time_s - counts[LAST_S])
    for i in range(6):
        memory[CHANGE, i] = innovation[i] - memory[RESIDUAL, i]
        memory[RESIDUAL, i] = noted.residual[i]
        memory[SUM, i] += innovation[i]
    counts[IN_SPAN] += 1.0
    counts[NEIGHBOURS] += 1.0
    counts[LAST_S] = time_s
    span_s = time_s - counts[BEGAN_S]
    if span_s >= SPAN_S - 1e-6:
        _end_span(memory[:], time_s)
        if counts[SPANS] > 2.0:
            _relate(noted, min(span_s, LONGEST_SPAN_S))


@kernel
def interrupt(noted: Any) -> None:
    """Do not correlate the next innovation with the last one: after a jump, a gap or a restart."""
    for i in range(MEMORY_SHAPE[1]):
        noted.memory[SUM, i] = noted.memory[COUNTS, i] = 0.0


@kernel
def white_sd(noted: Any, kind: int) -> float:
    """Standard deviation of the noise of position (`kind` 0, m) or velocity (1, m/s)."""
    return math.sqrt(max(noted.variance[kind], noted.least[kind]))


class Adaptation:
    """Estimated noise and drift of one observer.

    Args:
        record: an ADAPTATION (1,), which is filled.
        position_sd_m, velocity_sd_mps: least standard deviations of the measurement noise.
        density_mps2, density_limit_mps2: least and greatest density of the disturbance, per root
            second.
    """

    def __init__(
        self,
        record: np.ndarray[Any, Any],
        position_sd_m: float,
        velocity_sd_mps: float,
        density_mps2: float,
        density_limit_mps2: float,
    ) -> None:
        self._record = record
        self._noted = record.view(np.recarray)[0]
        record["least"] = np.square((position_sd_m, velocity_sd_mps))
        self._limit_mps2 = max(density_mps2, density_limit_mps2)
        self._bounds = record["bounds"][0]
        self._bounds[:] = density_mps2
        self.reset()

    def reset(self) -> None:
        """Start from the configured values."""
        self._record["variance"] = 0.0
        self._record["memory"] = 0.0
        self._bounds[NORTH_EAST, 1] = self._limit_mps2
        self._bounds[DOWN, 1] = self._bounds[DOWN, 0]
        self._record["density"] = self._bounds[:, 0]

    def trust_thrust(self) -> None:
        """From now on the vertical density may grow too. Before the thrust is identified, an error
        of its delay looks like drift, and a faster correction would make the vehicle oscillate."""
        self._bounds[DOWN, 1] = self._limit_mps2

    def interrupt(self) -> None:
        """Do not correlate the next innovation with the last one: after a gap or a restart."""
        interrupt(self._noted)

    @property
    def position_sd_m(self) -> float:
        return white_sd(self._noted, 0)

    @property
    def velocity_sd_mps(self) -> float:
        return white_sd(self._noted, 1)

    @property
    def densities_mps2(self) -> Array:
        """Drift densities of the disturbance, lateral and vertical, per root second."""
        densities: Array = self._record["density"][0]
        return densities
