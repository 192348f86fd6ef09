"""What a geometric path is to the rest of the room, and the polynomial one.

A path maps its own time s (seconds at full speed) to a position and its derivatives with respect
to s. It knows nothing of the vehicle's time, of starting and stopping (`track`) or of course.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

Array = NDArray[np.float64]

ORDERS = 5  # position, velocity, acceleration, jerk, snap


class Path(Protocol):
    """Position along a path and its first four derivatives, analytic in s.

    `length_s` is the time that the path takes at full speed. A `bounded` path is defined on
    [0, length_s] only; another continues smoothly beyond both ends (laps of a closed curve).
    """

    @property
    def length_s(self) -> float: ...

    @property
    def bounded(self) -> bool: ...

    def jet(self, path_time_s: Array) -> Array:
        """Derivatives 0 to 4 with respect to s, (5, N, 3), NED and SI, for s of shape (N,)."""
        ...


@dataclass(frozen=True, slots=True)
class Polynomial:
    """A piecewise polynomial on [0, length_s] with any number of columns (3 for a path).

    breaks_s (M + 1,) increasing; coefficients (ORDERS, M, K, C): for each derivative and piece
    the factors of (s - break)^k, lowest power first. Outside, the end pieces continue.
    """

    breaks_s: Array
    coefficients: Array
    bounded: bool = True

    @classmethod
    def from_taylor(cls, breaks_s: Array, taylor: Array) -> Polynomial:
        """From the factors of (s - break)^k, lowest power first, (M, K, C)."""
        pieces, powers, columns = taylor.shape
        coefficients = np.zeros((ORDERS, pieces, powers, columns))
        coefficients[0] = taylor
        factors = np.arange(1.0, powers)[:, np.newaxis]
        for order in range(1, ORDERS):
            coefficients[order, :, :-1] = coefficients[order - 1, :, 1:] * factors
        return cls(breaks_s, coefficients)

    @classmethod
    def from_spline(cls, spline: BSpline) -> Polynomial:
        """From a SciPy B-spline with C columns: one piece between any two different knots."""
        breaks = np.unique(spline.t[spline.k : spline.t.size - spline.k])
        derivatives = [
            spline(breaks[:-1], nu=power) / math.factorial(power) for power in range(spline.k + 1)
        ]
        return cls.from_taylor(breaks, np.stack(derivatives, axis=1))

    @property
    def length_s(self) -> float:
        return float(self.breaks_s[-1])

    def jet(self, path_time_s: Array) -> Array:
        """Derivatives 0 to 4, shape (5, N, C), for s of shape (N,)."""
        inner = self.breaks_s[1:-1]
        piece = np.searchsorted(inner, path_time_s, side="right")
        offset = path_time_s - self.breaks_s[piece]
        powers = offset[:, np.newaxis] ** np.arange(self.coefficients.shape[2])
        result: Array = np.einsum("dnkc,nk->dnc", self.coefficients[:, piece], powers)
        return result
