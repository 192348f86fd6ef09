"""Metrics of a signal weighted by time.

Between two samples a signal is taken to change linearly: each sample stands for half of the
interval before it and half of the one after it (the trapezoidal rule). So a metric does not depend
on how often the signal was sampled, and a gap counts with its length and the mean of its ends.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def shares(times: Array) -> Array:
    """Time (N,) in s for which each sample stands; `times` (N,) must not decrease."""
    intervals = np.diff(times)
    return 0.5 * (np.append(intervals, 0.0) + np.insert(intervals, 0, 0.0))[: len(times)]


@dataclass(frozen=True, slots=True)
class Weighted:
    """Metrics of one signal; `p95` is not exceeded for 95 % of the time. NaN without samples."""

    mean: float = math.nan
    rms: float = math.nan
    sd: float = math.nan
    max: float = math.nan
    p95: float = math.nan


def weighted(values: Array, weights: Array) -> Weighted:
    """Metrics of samples (N,) with their `shares` (N,). Those that stand for no time do not
    count."""
    values, weights = values[weights > 0.0], weights[weights > 0.0]
    total = float(weights.sum())
    if not total:
        return Weighted()
    mean, square = float(weights @ values / total), float(weights @ values**2 / total)
    order = np.argsort(values)
    at = int(np.searchsorted(np.cumsum(weights[order]), 0.95 * total))
    return Weighted(
        mean=mean,
        rms=math.sqrt(square),
        sd=math.sqrt(max(square - mean**2, 0.0)),
        max=float(values.max()),
        p95=float(values[order[min(at, len(order) - 1)]]),
    )
