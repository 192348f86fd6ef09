"""The swarm for a `BoxQuadratic`, entirely in compiled code.

It moves the particles exactly as `Swarm` does with the same random numbers. It runs in chunks of
iterations and asks between them how much time is left.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offboard.compiled import array, entry, kernel
from offboard.control.cost import BoxQuadratic
from offboard.control.swarm.lanes import RandomLanes, States
from offboard.control.swarm.motion import SEARCH, move, remember, scatter, spread_about
from offboard.control.swarm.population import Population, box
from offboard.control.swarm.settings import SwarmHistory, SwarmResult, SwarmSettings

Array = NDArray[np.float64]

CHUNK_ITERATIONS = 25  # about 15 us


@entry(
    SEARCH, array(1, "u8"), array(1), array(1), array(2), array(2), array(2), array(1),
    array(1), array(1), array(2), array(1),
)  # fmt: skip
def iterate(
    searches: Any,
    lanes: States,
    lower: Array,
    upper: Array,
    positions: Array,
    velocities: Array,
    bests: Array,
    leader: Array,
    best_costs: Array,
    costs: Array,
    hessian: Array,
    gradient: Array,
) -> None:
    """Iterate up to the limit. The first iteration evaluates the particles where they start."""
    search = searches[0]
    while search.iterations < search.limit:
        if search.iterations > 0:
            move(search, lanes, lower, upper, positions, velocities, bests, leader)
        quadratic_costs(hessian, gradient, search.constant, positions, costs)
        remember(search, costs, positions, bests, best_costs, leader)
    search.spread = spread_about(positions, leader)


@kernel
def quadratic_costs(
    hessian: Array, gradient: Array, constant: float, positions: Array, costs: Array
) -> None:
    """Compute J of positions (n, particles), costs (particles,)."""
    if positions.shape[0] == 4:
        _costs_of_four(hessian, gradient, constant, positions, costs)
        return
    costs[:] = constant
    for j in range(positions.shape[0]):
        for i in range(positions.shape[1]):
            slope = gradient[j] + 0.5 * hessian[j, j] * positions[j, i]
            for k in range(j):
                slope += hessian[j, k] * positions[k, i]
            costs[i] += positions[j, i] * slope


@kernel
def _costs_of_four(
    hessian: Array, gradient: Array, constant: float, positions: Array, costs: Array
) -> None:
    """The same for four inputs, unrolled: a search takes a third of the time."""
    h00, h11 = 0.5 * hessian[0, 0], 0.5 * hessian[1, 1]
    h22, h33 = 0.5 * hessian[2, 2], 0.5 * hessian[3, 3]
    h10, h20, h21 = hessian[1, 0], hessian[2, 0], hessian[2, 1]
    h30, h31, h32 = hessian[3, 0], hessian[3, 1], hessian[3, 2]
    g0, g1, g2, g3 = gradient[0], gradient[1], gradient[2], gradient[3]
    for i in range(positions.shape[1]):
        a, b, c, d = positions[0, i], positions[1, i], positions[2, i], positions[3, i]
        costs[i] = (
            constant
            + a * (g0 + h00 * a)
            + b * (g1 + h11 * b + h10 * a)
            + c * (g2 + h22 * c + h20 * a + h21 * b)
            + d * (g3 + h33 * d + h30 * a + h31 * b + h32 * c)
        )


class QuadraticSwarm:
    """Minimises quadratics in `dimensions` inputs; its arrays are made once."""

    def __init__(self, settings: SwarmSettings, dimensions: int) -> None:
        self._settings = settings
        self._all = Population(settings, dimensions)
        self._hessian = np.empty((dimensions, dimensions))
        self._gradient = np.empty(dimensions)

    def minimise(
        self,
        problem: BoxQuadratic,
        lanes: RandomLanes,
        seeds: Sequence[ArrayLike] = (),
        remaining_s: Callable[[], float] | None = None,
        keep_history: bool = False,
    ) -> SwarmResult:
        """The best input found within the bounds of the problem.

        `remaining_s` returns how many seconds are left; when none are, the search ends with the
        best so far, after one chunk of iterations at the earliest. `keep_history` keeps every
        iteration. Raises ValueError for bounds that are not finite and ordered, or of another
        dimension.
        """
        arguments = self._start(problem, lanes, seeds)
        p, limit, tolerance = self._all, self._settings.iterations, self._settings.tolerance
        watched = remaining_s is not None or tolerance > 0
        chunk = 1 if keep_history else CHUNK_ITERATIONS if watched else limit
        kept: list[tuple[Array, float, float]] = []
        done, cut_short = 0, False
        while done < limit:
            p.limit[0] = done = min(done + chunk, limit)
            iterate(*arguments)
            if keep_history:
                kept.append((p.positions.T.copy(), float(p.cost[0]), float(p.spread[0])))
            if tolerance > 0 and p.spread[0] <= tolerance:
                break
            if done < limit and remaining_s is not None and remaining_s() <= 0:
                cut_short = True
                break
        return p.result(cut_short, _history(kept) if keep_history else None)

    def _start(
        self, problem: BoxQuadratic, lanes: RandomLanes, seeds: Sequence[ArrayLike]
    ) -> tuple[Any, ...]:
        """Scatter the particles and return the arguments of `iterate`."""
        p = self._all
        p.confine(box(problem.lower, problem.upper))
        self._hessian[:] = problem.hessian
        self._gradient[:] = problem.gradient
        p.search["constant"] = problem.constant
        drawn = lanes.states(self._settings.particles)
        where = p.search, drawn, p.lower, p.upper, p.positions, p.velocities
        scatter(*where)
        p.begin(seeds)
        return (*where, p.bests, p.leader, p.best_costs, p.costs, self._hessian, self._gradient)


def _history(kept: list[tuple[Array, float, float]]) -> SwarmHistory:
    positions, costs, spreads = zip(*kept, strict=True)
    return SwarmHistory(np.array(positions), np.array(costs), np.array(spreads))
