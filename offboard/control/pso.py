"""The law `pso`: the cost of one held input and all that follows, minimised by the swarm."""

from __future__ import annotations

from typing import Literal

import numpy as np

from offboard.control.base import Decision, Situation
from offboard.control.law import TrackingLaw, TrackingSettings, decision
from offboard.control.quadratic import ExactMinimum
from offboard.control.swarm import SwarmSettings, certify, minimise
from offboard.model.vehicle import Vehicle


class PsoSettings(TrackingSettings):
    """Settings of the law `pso`."""

    law: Literal["pso"] = "pso"
    swarm: SwarmSettings = SwarmSettings()

    def build(self, vehicle: Vehicle, *, period_s: float, seed: int) -> PsoLaw:
        return PsoLaw(vehicle, self, period_s=period_s, seed=seed)


class PsoLaw(TrackingLaw):
    """Searches within the bounds of each decision; certified against the exact minimum."""

    def __init__(
        self, vehicle: Vehicle, settings: PsoSettings, *, period_s: float = 0.1, seed: int = 0
    ) -> None:
        super().__init__(vehicle, settings, period_s)
        self._swarm, self._seed = settings.swarm, seed
        self._rng = np.random.default_rng(seed)
        self._exact = ExactMinimum(4)

    def decide(self, situation: Situation) -> Decision:
        problem = self.task(situation).problem
        result = minimise(self._swarm, problem, self._rng, situation.remaining_s)
        return decision(result.best, certify(problem, result, self._exact))

    def reset(self) -> None:
        super().reset()
        self._rng = np.random.default_rng(self._seed)
