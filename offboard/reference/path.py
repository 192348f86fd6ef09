"""Geometric paths: what a shape has to provide, and the two kinds that there are.

A path maps its own time s (seconds at full speed) to a position and its derivatives with respect
to s. Starting and stopping is added by `track`, where the nose points by `heading`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

Array = NDArray[np.float64]
Triple = tuple[float, float, float]

ORDERS = 5  # position, velocity, acceleration, jerk, snap
_ORDER = np.arange(ORDERS, dtype=np.float64)[:, np.newaxis, np.newaxis]
_ZERO: Triple = (0.0, 0.0, 0.0)


class Path(Protocol):
    """Position along a path and its first four derivatives, analytic in s.

    `length_s` is the time that the path takes at full speed. A `bounded` path is defined on
    [0, length_s] only; any other continues smoothly beyond both ends (laps of a closed curve).
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


@dataclass(frozen=True, slots=True)
class Harmonic:
    """p_i(s) = offset_i + slope_i s + amplitude_i sin(omega_i s + phase_i), i = north, east, down.

    One sine per axis on top of a straight motion: enough for lines, circles, helices and figures
    of eight, with all derivatives in closed form. SI.
    """

    length_s: float
    bounded: bool = False
    offset_ned_m: Triple = _ZERO
    slope_ned_mps: Triple = _ZERO
    amplitude_ned_m: Triple = _ZERO
    omega_ned_radps: Triple = _ZERO
    phase_ned_rad: Triple = _ZERO

    def jet(self, path_time_s: Array) -> Array:
        """Derivatives 0 to 4 with respect to s, shape (5, N, 3), for s of shape (N,)."""
        time = path_time_s[:, np.newaxis]
        omega = np.array(self.omega_ned_radps)
        angle = omega * time + np.array(self.phase_ned_rad)
        # d/ds of sin(omega s + phase) adds a quarter turn and a factor omega
        scale = np.array(self.amplitude_ned_m) * omega**_ORDER
        result: Array = scale * np.sin(angle + 0.5 * math.pi * _ORDER)
        slope = np.array(self.slope_ned_mps)
        result[0] += np.array(self.offset_ned_m) + slope * time
        result[1] += slope
        return result
