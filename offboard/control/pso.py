"""The law `pso`: the cost of one held input and all that follows, minimised by the swarm."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from offboard.control.base import Decision, Situation
from offboard.control.law import OneDecisionSettings, Tracking, decision
from offboard.control.quadratic import ExactMinimum
from offboard.control.swarm import SwarmSettings, certify, minimise
from offboard.model.vehicle import Vehicle


class PsoSettings(OneDecisionSettings):
    """Settings of the law `pso`."""

    law: Literal["pso"] = "pso"
    swarm: SwarmSettings = SwarmSettings()

    def build(self, vehicle: Vehicle, *, period_s: float, seed: int) -> PsoLaw:
        return PsoLaw(vehicle, self, period_s=period_s, seed=seed)


class PsoLaw:
    """Searches within the bounds of each decision; certified against the exact minimum."""

    def __init__(
        self, vehicle: Vehicle, settings: PsoSettings, *, period_s: float = 0.1, seed: int = 0
    ) -> None:
        self.bandwidth_radps = settings.bandwidth_radps
        self.tracking = Tracking(vehicle, settings, period_s, settings.feedforward)
        self._vehicle = vehicle
        self._swarm, self._seed = settings.swarm, seed
        self._rng = np.random.default_rng(seed)
        self._exact = ExactMinimum(4)

    def decide(self, situation: Situation) -> Decision:
        problem = self.tracking.task(situation).problem
        result = minimise(self._swarm, problem, self._rng, remaining_s=situation.remaining_s)
        return decision(result.best, certify(problem, result, self._exact))

    def reset(self) -> None:
        self._rng = np.random.default_rng(self._seed)
        self.adopt(self._vehicle)

    def adopt(
        self, vehicle: Vehicle, bandwidth_limit_radps: float = math.inf, *, gains: bool = True
    ) -> None:
        self.tracking.adopt(vehicle, bandwidth_limit_radps, gains=gains)
