"""The swarm for any objective, as ask/tell: the caller owns loop, evaluation and deadline.

    swarm = Swarm(lower, upper, settings, lanes)
    for _ in range(settings.iterations):
        swarm.tell(objective(swarm.ask()))
    answer = swarm.result()

Arguments are copied.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offboard.control.swarm.lanes import RandomLanes
from offboard.control.swarm.motion import learn, move_particles, scatter
from offboard.control.swarm.population import Population, box
from offboard.control.swarm.settings import SwarmResult, SwarmSettings

Array = NDArray[np.float64]


class Swarm:
    """One search within bounds (n,). The first particles start from `seeds`, (n,) each: the answer
    is never worse than the best of them."""

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        settings: SwarmSettings,
        lanes: RandomLanes,
        seeds: Sequence[ArrayLike] = (),
    ) -> None:
        within = box(lower, upper)
        self._all = p = Population(settings, len(within.lower))
        p.confine(within)
        self._drawn = lanes.states(settings.particles)
        scatter(p.search, self._drawn, p.lower, p.upper, p.positions, p.velocities)
        p.begin(seeds)
        self._told = False

    def ask(self) -> Array:
        """Inputs to evaluate, (particles, n); the same until `tell` is called."""
        if self._told:
            p = self._all
            where = p.search, self._drawn, p.lower, p.upper, p.positions, p.velocities
            move_particles(*where, p.bests, p.leader)
            self._told = False
        return self._all.positions.T.copy()

    def tell(self, costs: ArrayLike) -> None:
        """Give the costs (particles,) of the inputs returned by `ask`; NaN and -inf count as +inf.

        Raises ValueError for another shape, or where `ask` was not called since the last `tell`.
        """
        values, p = np.asarray(costs, np.float64), self._all
        if self._told:
            raise ValueError("tell without ask: these inputs already have their costs")
        if values.shape != p.costs.shape:
            raise ValueError(f"{values.shape} costs for {p.costs.shape} particles")
        p.costs[:] = values
        learn(p.search, p.costs, p.positions, p.bests, p.best_costs, p.leader)
        self._told = True

    @property
    def spread(self) -> float:
        """Epsilon of Eq. 29 after the last `tell`."""
        return float(self._all.spread[0])

    def result(self, cut_short: bool = False) -> SwarmResult:
        """The best input so far."""
        return self._all.result(cut_short)
