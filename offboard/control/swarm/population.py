"""The arrays of a swarm, made once and changed in place by compiled code."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offboard.control.swarm.motion import SEARCH
from offboard.control.swarm.settings import SwarmHistory, SwarmResult, SwarmSettings

Array = NDArray[np.float64]


class Box(NamedTuple):
    """Bounds of Eq. 22, each (n,). Equal bounds fix a dimension."""

    lower: Array
    upper: Array


def box(lower: ArrayLike, upper: ArrayLike) -> Box:
    """Copies of the bounds. Raises ValueError where their shapes differ, lower exceeds upper, or
    anything is not finite."""
    low = np.array(lower, np.float64, order="C")
    high = np.array(upper, np.float64, order="C")
    if low.ndim != 1 or low.shape != high.shape or not low.size:
        raise ValueError(f"bounds must be two equal vectors, got {low.shape} and {high.shape}")
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low <= high).all()):
        raise ValueError(f"bounds must be finite and ordered, got {low} and {high}")
    return Box(low, high)


class Population:
    """The particles of a swarm in `dimensions` inputs.

    positions, velocities, bests (n, particles); costs, best_costs (particles,); leader, lower,
    upper (n,); search, one `SEARCH`, of which limit, cost and spread are views (1,).
    """

    def __init__(self, settings: SwarmSettings, dimensions: int) -> None:
        shape = (dimensions, settings.particles)
        self.positions, self.velocities, self.bests = (np.empty(shape) for _ in range(3))
        self.costs, self.best_costs = (np.empty(settings.particles) for _ in range(2))
        self.leader, self.lower, self.upper = (np.empty(dimensions) for _ in range(3))
        self.search = np.zeros(1, SEARCH)
        for name in ("inertia", "personal", "social", "damping", "rebound", "initial_velocity"):
            self.search[name] = getattr(settings, name)
        self.limit, self.cost, self.spread = (self.search[n] for n in ("limit", "cost", "spread"))

    def confine(self, within: Box) -> None:
        """Set the bounds. Raises ValueError where they have another dimension."""
        if len(within.lower) != len(self.leader):
            raise ValueError(f"{len(within.lower)} inputs for a swarm of {len(self.leader)}")
        self.lower[:], self.upper[:] = within

    def begin(self, seeds: Sequence[ArrayLike]) -> None:
        """Move the first particles to the `seeds`, clamped to the bounds, and clear the memory.
        Seeds that are not finite, and more seeds than particles, are ignored."""
        usable = [
            seed for seed in (np.asarray(s, np.float64) for s in seeds) if np.isfinite(seed).all()
        ]
        for i, seed in enumerate(usable[: len(self.costs)]):
            self.positions[:, i] = np.clip(seed, self.lower, self.upper)
        self.bests[:] = self.positions
        self.best_costs.fill(np.inf)
        self.leader[:] = self.positions[:, 0]

    def result(self, cut_short: bool, history: SwarmHistory | None = None) -> SwarmResult:
        """The best input so far."""
        found = self.search[0]
        return SwarmResult(
            self.leader.copy(),
            cost=float(found["cost"]),
            spread=float(found["spread"]),
            iterations=int(found["iterations"]),
            cut_short=cut_short,
            rejected=int(found["rejected"]),
            history=history,
        )
