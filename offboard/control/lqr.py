"""The law `lqr`: the minimiser of the same cost as `pso`, in closed form.

The axes are not coupled, so that each input is clip(-f / h).
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from offboard.control.base import Certificate, Decision, Situation
from offboard.control.law import OneDecisionSettings, Tracking, decision
from offboard.control.quadratic import at_bound, closed_form
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]


class LqrSettings(OneDecisionSettings):
    """Settings of the law `lqr`."""

    law: Literal["lqr"] = "lqr"

    def build(self, vehicle: Vehicle, *, period_s: float, seed: int) -> LqrLaw:
        return LqrLaw(vehicle, self, period_s=period_s)


class LqrLaw:
    """Linear-quadratic regulator with clipped inputs."""

    def __init__(self, vehicle: Vehicle, settings: LqrSettings, *, period_s: float = 0.1) -> None:
        self.bandwidth_radps = settings.bandwidth_radps
        self.tracking = Tracking(vehicle, settings, period_s, settings.feedforward)
        self._vehicle = vehicle

    def decide(self, situation: Situation) -> Decision:
        problem = self.tracking.task(situation).problem
        inputs = closed_form(problem)
        cost = float(problem(inputs))
        on_bound = at_bound(problem, inputs)
        return decision(inputs, Certificate(cost, optimal_cost=cost, gap=0.0, at_bound=on_bound))

    def reset(self) -> None:
        self.adopt(self._vehicle)

    def adopt(
        self, vehicle: Vehicle, bandwidth_limit_radps: float = math.inf, *, gains: bool = True
    ) -> None:
        self.tracking.adopt(vehicle, bandwidth_limit_radps, gains=gains)
