"""What the observer's innovations say of its own constants, compiled: noise and drift, online.

With the right constants innovations are white (R. Mehra, 1970). What differs between neighbouring
messages and comes back at once is noise of the measurement itself, more of it than believed. What
stays for a fifth of a second is a disturbance that drifts faster than believed (gusts); PX4's and
ArduCopter's estimators wander, but their innovations are over by then. Both estimates are slow,
bounded, and never below what is configured. Knows no message, no plant and no clock.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import kernel

Array = NDArray[np.float64]

NOISE_TIME_S = 3.0
NOISE_OUTLIER = 25.0  # a single product counts for at most so many times the variance
# Innovations are averaged over SPAN_S and compared with those two spans earlier.
SPAN_S, DRIFT_TIME_S = 0.1, 3.0
RELATED = 0.25  # the correlation above which the density grows, by e in a second at 1 above
VISIBLE_M = 5e-5  # innovations smaller than this say nothing
LONGEST_SPAN_S = 0.3
NORTH_EAST, DOWN = 0, 1

# Rows of the memory, six numbers each: position and velocity, NED.
RESIDUAL, CHANGE = 0, 1  # of the last message, see `_weigh`
MEANS = 2  # of the innovations over the newest three spans, newest first; position only
RELATION = 5  # mean product (lateral, vertical) and mean square (the same) of the means
SUM = 6  # of the innovations in this span
COUNTS = 7  # messages in this span, neighbours heard, spans ended, begin of the span, last message
MEMORY_SHAPE = (8, 6)
IN_SPAN, NEIGHBOURS, SPANS, BEGAN_S, LAST_S = 0, 1, 2, 3, 4

ADAPTATION = np.dtype(
    [
        ("memory", "f8", MEMORY_SHAPE),
        ("least", "f8", 2),  # white variances of position and velocity: configured,
        ("variance", "f8", 2),  # and measured
        ("bounds", "f8", (2, 2)),  # least and greatest density, lateral and vertical
        ("density", "f8", 2),
        # of one message, before and after its correction: position (m) and velocity (m/s), NED
        ("innovation", "f8", 6),
        ("residual", "f8", 6),
    ],
    align=True,
)
"""What is learnt, and what it is learnt from."""


@kernel
def _weigh(noted: Any, interval_s: float) -> None:
    """White variances of position and velocity from their innovations.

    The measured change since the last message less the predicted one is innovation - residual;
    for white noise of variance s^2 neighbouring changes have the covariance -s^2, for a measured
    value that wanders none.
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
    """Densities of the disturbance, lateral and vertical, from the means of three spans."""
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
    """Learn from one message."""
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
    """The next innovation is no neighbour of the last one: a jump, a gap, a new start."""
    for i in range(MEMORY_SHAPE[1]):
        noted.memory[SUM, i] = noted.memory[COUNTS, i] = 0.0


@kernel
def white_sd(noted: Any, kind: int) -> float:
    """Standard deviation of the noise of position (0) or velocity (1)."""
    return math.sqrt(max(noted.variance[kind], noted.least[kind]))


class Adaptation:
    """An ADAPTATION record as whoever configures it sees it.

    `position_sd_m`, `velocity_sd_mps` and `density_mps2`, `density_limit_mps2` are the least and
    (of the density) greatest values.
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
        """Believe what is configured."""
        self._record["variance"] = 0.0
        self._record["memory"] = 0.0
        self._bounds[NORTH_EAST, 1] = self._limit_mps2
        self._bounds[DOWN, 1] = self._bounds[DOWN, 0]
        self._record["density"] = self._bounds[:, 0]

    def trust_thrust(self) -> None:
        """From now on the vertical density may grow too. A thrust that acts later than believed
        looks like drift, and answering it faster makes it oscillate."""
        self._bounds[DOWN, 1] = self._limit_mps2

    def interrupt(self) -> None:
        """The next innovation is no neighbour of the last one: a gap, a new start."""
        interrupt(self._noted)

    @property
    def position_sd_m(self) -> float:
        return white_sd(self._noted, 0)

    @property
    def velocity_sd_mps(self) -> float:
        return white_sd(self._noted, 1)

    @property
    def densities_mps2(self) -> Array:
        """Noise densities of the disturbance, lateral and vertical."""
        densities: Array = self._record["density"][0]
        return densities
