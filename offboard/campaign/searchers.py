"""Optimisers of a cost on the unit cube, as ask/tell in batches: our swarm, CMA-ES, random points.

searcher = SEARCHERS["swarm"](dimensions, batch, seed)
searcher.tell([cost(point) for point in searcher.ask()])
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from offboard.control.swarm import Swarm, SwarmSettings
from offboard.documents.errors import UserError
from offboard.documents.extras import install

Array = NDArray[np.float64]
DAMPING = 0.85  # lambda of Eq. 30: slower than for control, where the cost is quadratic
FIRST_SD = 0.3  # of CMA-ES, share of each range


class Searcher(Protocol):
    """`ask` returns points (batch, n) within 0 .. 1, `tell` takes their costs (batch,)."""

    def ask(self) -> Array: ...

    def tell(self, costs: Sequence[float]) -> None: ...


class _Swarm:
    def __init__(self, dimensions: int, batch: int, seed: int) -> None:
        settings = SwarmSettings(particles=batch, damping=DAMPING)
        zeros, ones = np.zeros(dimensions), np.ones(dimensions)
        self._swarm = Swarm(settings, zeros, ones, np.random.default_rng(seed))

    def ask(self) -> Array:
        return self._swarm.ask()

    def tell(self, costs: Sequence[float]) -> None:
        self._swarm.tell(costs)


class _CmaEs:
    def __init__(self, dimensions: int, batch: int, seed: int) -> None:
        try:
            import cma
        except ImportError:
            raise UserError(
                f"the search method cma needs the package cma: {install('campaign')}, or set "
                "search.methods: [swarm]"
            ) from None
        options = {
            "bounds": [0.0, 1.0], "popsize": batch, "seed": seed + 1, "verbose": -9,
            "tolfun": 0.0, "tolx": 0.0,
        }  # fmt: skip
        self._search = cma.CMAEvolutionStrategy(dimensions * [0.5], FIRST_SD, options)
        self._asked: list[Array] = []

    def ask(self) -> Array:
        self._asked = self._search.ask()
        return np.array(self._asked)

    def tell(self, costs: Sequence[float]) -> None:
        self._search.tell(self._asked, list(costs))


class _Random:
    def __init__(self, dimensions: int, batch: int, seed: int) -> None:
        self._generator = np.random.default_rng(seed)
        self._shape = batch, dimensions

    def ask(self) -> Array:
        return self._generator.random(self._shape)

    def tell(self, costs: Sequence[float]) -> None:
        pass


SEARCHERS: dict[str, Callable[[int, int, int], Searcher]] = {
    "swarm": _Swarm,
    "cma": _CmaEs,
    "random": _Random,
}
