"""A quadratic cost within bounds, which the laws minimise, and its exact minimum.

The minimum is found by daqp, a dual active-set method that shares no code with the swarm. This
module does not know the meaning of the inputs.
"""

from __future__ import annotations

from dataclasses import dataclass

import daqp
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BOUND_FRACTION = 1e-6  # of the distance between the bounds: this near counts as at a bound


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
        """Return J (...) of inputs (..., n)."""
        quadratic: Array = np.einsum("...i,ij,...j->...", inputs, self.hessian, inputs)
        return 0.5 * quadratic + inputs @ self.gradient + self.constant

    def clip(self, inputs: Array) -> Array:
        """Return the nearest inputs (..., n) within the bounds."""
        clipped: Array = np.clip(inputs, self.lower, self.upper)
        return clipped


def at_bound(problem: BoxQuadratic, inputs: Array) -> bool:
    """Whether any input (n,) is at a bound; inputs fixed by equal bounds do not count."""
    width = problem.upper - problem.lower
    distance = np.minimum(inputs - problem.lower, problem.upper - inputs)
    return bool(np.any((distance <= BOUND_FRACTION * width) & (width > 0)))


class ExactMinimum:
    """Finds the exact minimum of quadratics in `dimensions` inputs; daqp's workspace is reused."""

    def __init__(self, dimensions: int) -> None:
        self._dimensions = dimensions
        self._free = np.zeros(dimensions, np.int32)  # no bound is active beforehand
        self._model = daqp.Model()
        no_rows, ones = np.empty((0, dimensions)), np.ones(dimensions)
        self._model.setup(
            np.eye(dimensions), np.zeros(dimensions), no_rows, ones, -ones, self._free
        )

    def minimise(self, problem: BoxQuadratic) -> Array:
        """Return the minimiser (n,) within the bounds; NaN if the problem is not finite or daqp
        does not solve it. With a singular Hessian, daqp returns one of many minimisers.
        """
        unsolved = np.full(self._dimensions, np.nan)
        if not (np.isfinite(problem.hessian).all() and np.isfinite(problem.gradient).all()):
            return unsolved
        status = self._model.update(
            H=np.ascontiguousarray(problem.hessian),
            f=np.ascontiguousarray(problem.gradient),
            bupper=np.ascontiguousarray(problem.upper),
            blower=np.ascontiguousarray(problem.lower),
            sense=self._free.copy(),
        )
        if status < 0:
            return unsolved
        minimiser, _, status, _ = self._model.solve()
        if status < 1:
            return unsolved
        return problem.clip(minimiser)
