"""How far an answer of the swarm is from the exact minimum of the same quadratic within bounds.

The minimum is found by daqp, a dual active-set method, so that swarm and certificate share no
code. Knows neither what the inputs mean nor how they were found.
"""

from __future__ import annotations

import daqp
import numpy as np
from numpy.typing import NDArray

from offboard.control.base import Certificate
from offboard.control.cost import BoxQuadratic
from offboard.control.swarm import SwarmResult

Array = NDArray[np.float64]

GAP_FLOOR = 1e-6  # times the variation of the cost within the bounds
BOUND_FRACTION = 1e-6  # times the distance between the bounds


class ExactMinimum:
    """Exact minimum of quadratics in `dimensions` inputs; daqp's workspace is made once."""

    def __init__(self, dimensions: int) -> None:
        self._dimensions = dimensions
        self._free = np.zeros(dimensions, np.int32)  # no bound is active beforehand
        self._model = daqp.Model()
        no_rows, ones = np.empty((0, dimensions)), np.ones(dimensions)
        self._model.setup(
            np.eye(dimensions), np.zeros(dimensions), no_rows, ones, -ones, self._free
        )

    def minimise(self, problem: BoxQuadratic) -> Array:
        """The minimiser (n,) within the bounds; NaN if the problem is not finite or not solved.

        A singular Hessian has many minimisers: daqp returns one of them.
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


def certify(
    problem: BoxQuadratic, result: SwarmResult, exact: ExactMinimum | None = None
) -> Certificate:
    """The certificate of `result`, the answer to `problem`. Pass `exact` to reuse its workspace.

    The gap is (J - J*) / max(|J*|, floor). J - J* is not computed as the difference of two costs,
    which near the optimum would be rounding errors only, but from the expansion about the
    minimiser: g*'d + 1/2 d'Hd with d = u - u* and g* = Hu* + f. A negative value (the swarm is
    better than daqp's tolerance) counts as 0. The floor is a millionth of the variation of J within
    the bounds; it keeps the gap meaningful exactly on the reference, where J* vanishes.
    """
    exact = exact or ExactMinimum(len(problem.gradient))
    best = exact.minimise(problem)
    optimal = float(problem(best))
    off = result.best - best
    slope = problem.hessian @ best + problem.gradient
    excess = float(slope @ off + 0.5 * off @ problem.hessian @ off)
    scale = max(abs(optimal), GAP_FLOOR * _variation(problem))
    gap = max(excess, 0.0) / scale if scale > 0 else (0.0 if scale == 0 else float("nan"))
    return Certificate(
        cost=result.cost,
        optimal_cost=optimal,
        gap=gap,
        spread=result.spread,
        iterations=result.iterations,
        cut_short=result.cut_short,
        at_bound=at_bound(problem, result.best),
    )


def at_bound(problem: BoxQuadratic, inputs: Array) -> bool:
    """Whether any input (n,) rests on a bound; inputs fixed by equal bounds do not count."""
    width = problem.upper - problem.lower
    distance = np.minimum(inputs - problem.lower, problem.upper - inputs)
    return bool(np.any((distance <= BOUND_FRACTION * width) & (width > 0)))


def _variation(problem: BoxQuadratic) -> float:
    """An upper estimate of the variation of J within the bounds."""
    width = problem.upper - problem.lower
    middle = 0.5 * (problem.lower + problem.upper)
    slope = problem.hessian @ middle + problem.gradient
    return float(np.abs(slope) @ width + width @ np.abs(problem.hessian) @ width / 8)
