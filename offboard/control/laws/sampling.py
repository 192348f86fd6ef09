"""The laws `mppi` and `cem`: the roll-outs of `horizon`, searched by sampling.

They exist for comparison with the swarm at the same number of roll-outs.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from offboard.control.base import Decision, Situation
from offboard.control.horizon.planner import Planner, RollOutSettings, lowest_cost
from offboard.control.horizon.sampling import CemSampling, MppiSampling, sample
from offboard.model.vehicle import Vehicle


class MppiSettings(RollOutSettings):
    """Settings of the law `mppi`: model predictive path integral control."""

    law: Literal["mppi"] = "mppi"
    sampling: MppiSampling = MppiSampling()

    def build(self, vehicle: Vehicle, *, period_s: float, seed: int) -> SamplingLaw:
        return SamplingLaw(vehicle, self, period_s=period_s, seed=seed)


class CemSettings(RollOutSettings):
    """Settings of the law `cem`: the cross-entropy method."""

    law: Literal["cem"] = "cem"
    sampling: CemSampling = CemSampling()

    def build(self, vehicle: Vehicle, *, period_s: float, seed: int) -> SamplingLaw:
        return SamplingLaw(vehicle, self, period_s=period_s, seed=seed)


class SamplingLaw:
    """Samples about the cheaper of the closed form's plan and the previous one."""

    def __init__(
        self,
        vehicle: Vehicle,
        settings: MppiSettings | CemSettings,
        *,
        period_s: float = 0.1,
        seed: int = 0,
    ) -> None:
        self.bandwidth_radps = settings.bandwidth_radps
        self.planner = Planner(vehicle, settings, period_s)
        self._vehicle = vehicle
        self._sampling = settings.sampling
        self._seed = seed
        self._generator = np.random.default_rng(seed)

    def decide(self, situation: Situation) -> Decision:
        planner = self.planner
        task, linear = planner.prepare(situation)
        base = planner.own_plan(situation.time_s)
        seed_cost = lowest_cost([base])
        found = sample(
            planner.evaluate,
            base,
            planner.reach,
            self._sampling,
            self._generator,
            situation.remaining_s,
        )
        return planner.conclude(situation, task, linear, found, seed_cost)

    def reset(self) -> None:
        self.planner.previous = None
        self._generator = np.random.default_rng(self._seed)
        self.adopt(self._vehicle)

    def adopt(
        self, vehicle: Vehicle, bandwidth_limit_radps: float = math.inf, *, gains: bool = True
    ) -> None:
        self.planner.adopt(vehicle, bandwidth_limit_radps, gains=gains)
