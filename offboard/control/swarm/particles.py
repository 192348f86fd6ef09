"""The swarm as ask/tell: the caller owns the loop, the evaluation and the deadline.

    swarm = Swarm(lower, upper, settings, lanes)
    for _ in range(settings.iterations):
        swarm.tell(objective(swarm.ask()))
    answer = swarm.result()

Knows the objective only by the costs it is told. What callers hand in is copied: compiled code
would be compiled again, in flight, for a read-only or strided array.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offboard.control.swarm.lanes import RandomLanes
from offboard.control.swarm.motion import move, remember, scatter, spread_about
from offboard.control.swarm.settings import SwarmResult, SwarmSettings

Array = NDArray[np.float64]


class Box(NamedTuple):
    """Bounds of Eq. 22, each (n,). Equal bounds fix a dimension."""

    lower: Array
    upper: Array


def box(lower: ArrayLike, upper: ArrayLike) -> Box:
    """Checked copies. Raises ValueError on shapes that differ, disorder or anything not finite."""
    low = np.array(lower, np.float64, order="C")
    high = np.array(upper, np.float64, order="C")
    if low.ndim != 1 or low.shape != high.shape or not low.size:
        raise ValueError(f"bounds must be two equal vectors, got {low.shape} and {high.shape}")
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low <= high).all()):
        raise ValueError(f"bounds must be finite and ordered, got {low} and {high}")
    return Box(low, high)


def place_seeds(positions: Array, seeds: Sequence[ArrayLike], within: Box) -> None:
    """Put the first particles of `positions` (n, particles) on `seeds`, clamped to the box.

    Seeds that are not finite or beyond the number of particles are left out.
    """
    usable = [
        seed for seed in (np.asarray(s, np.float64) for s in seeds) if np.isfinite(seed).all()
    ]
    for i, seed in enumerate(usable[: positions.shape[1]]):
        positions[:, i] = np.clip(seed, within.lower, within.upper)


class Swarm:
    """One search in a box. `seeds` are inputs (n,) that the first particles start from: the answer
    is never worse than the best of them."""

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        settings: SwarmSettings,
        lanes: RandomLanes,
        seeds: Sequence[ArrayLike] = (),
    ) -> None:
        self._box = box(lower, upper)
        self._settings = settings
        self._lanes = lanes
        shape = (len(self._box.lower), settings.particles)
        self._positions = np.empty(shape)
        self._velocities = np.empty(shape)
        states = lanes.states(settings.particles)
        scatter(states, *self._box, settings.initial_velocity, self._positions, self._velocities)
        place_seeds(self._positions, seeds, self._box)
        self._bests = self._positions.copy()
        self._best_costs = np.full(settings.particles, np.inf)
        self._leader = self._positions[:, 0].copy()
        self._leader_cost = np.inf
        self._iterations = 0
        self._rejected = 0
        self._told = False

    def ask(self) -> Array:
        """Inputs to evaluate, (particles, n). Asking again without telling gives the same."""
        if self._told:
            s = self._settings
            move(
                self._lanes.states(s.particles), *self._box,
                s.inertia, s.personal, s.social, s.damping, s.rebound,
                self._positions, self._velocities, self._bests, self._leader,
            )  # fmt: skip
            self._told = False
        return self._positions.T.copy()

    def tell(self, costs: ArrayLike) -> None:
        """The costs (particles,) of the inputs last asked for. What is not finite counts as +inf.

        Raises ValueError on another shape or if nothing was asked since the last call.
        """
        values = np.array(costs, np.float64, order="C")
        if self._told:
            raise ValueError("tell without ask: these inputs already have their costs")
        if values.shape != self._best_costs.shape:
            raise ValueError(f"{values.shape} costs for {self._best_costs.shape} particles")
        self._leader_cost, rejected = remember(
            values, self._positions, self._bests, self._best_costs, self._leader, self._leader_cost
        )
        self._rejected += rejected
        self._iterations += 1
        self._told = True

    @property
    def spread(self) -> float:
        """Epsilon of Eq. 29 now."""
        return float(spread_about(self._positions, self._leader))

    @property
    def converged(self) -> bool:
        """Whether the spread has fallen to the settings' tolerance (never, if that is 0)."""
        return self._told and self.spread <= self._settings.tolerance > 0

    def result(self, cut_short: bool = False) -> SwarmResult:
        """Best so far."""
        return SwarmResult(
            best=self._leader.copy(),
            cost=float(self._leader_cost),
            spread=self.spread,
            iterations=self._iterations,
            cut_short=cut_short,
            rejected=self._rejected,
        )
