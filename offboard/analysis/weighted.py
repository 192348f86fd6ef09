"""Figures of a signal weighted by time, collected portion by portion.

Between two samples a signal is taken to change linearly: each sample stands for half of the
interval before it and half of the one after it (the trapezoidal rule). So a figure does not depend
on how often the signal was sampled, and a gap counts with its length and the mean of its ends.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def shares(times: Array) -> Array:
    """Time (N,) in s for which each sample stands; `times` (N,) must not decrease."""
    intervals = np.diff(times)
    return 0.5 * (np.append(intervals, 0.0) + np.insert(intervals, 0, 0.0))[: len(times)]


class Weighted:
    """One signal; a portion begins with the last sample of the portion before. Figures are NaN
    until time has passed. `distribution`: keep 8 bytes of each sample, for `percentile`."""

    def __init__(self, *, distribution: bool = False) -> None:
        self._values: list[NDArray[np.float32]] = []
        self._weights: list[NDArray[np.float32]] = []
        self._distribution = distribution
        self._sums = np.zeros(3)  # of the weights, times the value, times its square
        self.max = math.nan

    def add(self, values: Array, weights: Array) -> None:
        """Samples (N,) and their `shares` (N,). Those that stand for no time do not count."""
        values, weights = values[weights > 0.0], weights[weights > 0.0]
        if not len(values):
            return
        self._sums += weights @ np.stack((np.ones_like(values), values, values**2), axis=1)
        self.max = float(np.fmax(self.max, values.max()))
        if self._distribution:
            self._values.append(values.astype(np.float32))
            self._weights.append(weights.astype(np.float32))

    @property
    def mean(self) -> float:
        return float(self._sums[1] / self._sums[0]) if self._sums[0] > 0.0 else math.nan

    @property
    def rms(self) -> float:
        return math.sqrt(self._sums[2] / self._sums[0]) if self._sums[0] > 0.0 else math.nan

    @property
    def sd(self) -> float:
        return math.sqrt(max(self.rms**2 - self.mean**2, 0.0))

    def percentile(self, percent: float) -> float:
        """The value that is not exceeded for `percent` of the time."""
        if not self._sums[0] > 0.0:
            return math.nan
        # one array instead of the portions, which may take 20 MB
        self._values, self._weights = (
            [np.concatenate(portions)] for portions in (self._values, self._weights)
        )
        values, weights = self._values[0], self._weights[0]
        low, high = float(values.min()), float(values.max())
        while high - low > 1e-6 * abs(high) + 1e-12:  # sorting would take four times the memory
            middle = 0.5 * (low + high)
            below = weights[values <= middle].sum(dtype=np.float64)
            low, high = (low, middle) if below >= percent / 100 * self._sums[0] else (middle, high)
        return high
