"""A quadratic cost within bounds: what the laws minimise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class BoxQuadratic:
    """J(u) = 1/2 u' H u + f' u + c subject to lower <= u <= upper (Eq. 22).

    hessian (n, n) symmetric positive semidefinite, gradient (n,), constant scalar,
    lower and upper (n,).
    """

    hessian: Array
    gradient: Array
    constant: float
    lower: Array
    upper: Array

    def __call__(self, inputs: Array) -> Array:
        """J of inputs (..., n), shape (...)."""
        quadratic: Array = np.einsum("...i,ij,...j->...", inputs, self.hessian, inputs)
        return 0.5 * quadratic + inputs @ self.gradient + self.constant

    def clip(self, inputs: Array) -> Array:
        """The nearest inputs (..., n) within the bounds."""
        clipped: Array = np.clip(inputs, self.lower, self.upper)
        return clipped
