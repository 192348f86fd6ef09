"""Fewer points of a curve for display, with every peak in its place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
BINS = 1500


def thinned(values: Array, bins: int = BINS) -> NDArray[np.intp]:
    """Indices of `values` (N,) to draw: all, or the least and the greatest of each bin of equally
    many samples, and its first value that is not finite, which is a gap of the curve."""
    count = len(values)
    if count <= 2 * bins:
        return np.arange(count)
    edges = np.linspace(0, count, bins + 1).astype(np.intp)[:-1]
    of_bin = np.repeat(np.arange(bins), np.diff(np.append(edges, count)))
    known = np.isfinite(values)
    order = np.lexsort((values, ~known, of_bin))  # in each bin: finite ones first, ascending
    finite = np.add.reduceat(known, edges)
    least, greatest = order[edges], order[edges + np.maximum(finite, 1) - 1]
    gaps = order[(edges + finite)[finite < np.diff(np.append(edges, count))]]
    return np.unique(np.concatenate(([0, count - 1], least, greatest, gaps)))
