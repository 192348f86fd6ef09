"""The law `lqr`: the minimiser of the same cost as `pso`, in closed form.

The axes are not coupled, so that each input is clip(-f / h).
"""

from __future__ import annotations

from typing import Literal

from offboard.control.base import Certificate, Decision, Situation
from offboard.control.law import TrackingLaw, TrackingSettings, decision
from offboard.control.quadratic import at_bound, closed_form
from offboard.model.vehicle import Vehicle


class LqrSettings(TrackingSettings):
    """Settings of the law `lqr`."""

    law: Literal["lqr"] = "lqr"

    def build(self, vehicle: Vehicle, *, period_s: float, seed: int) -> LqrLaw:
        return LqrLaw(vehicle, self, period_s=period_s)


class LqrLaw(TrackingLaw):
    """Linear-quadratic regulator with clipped inputs."""

    def __init__(self, vehicle: Vehicle, settings: LqrSettings, *, period_s: float = 0.1) -> None:
        super().__init__(vehicle, settings, period_s)

    def decide(self, situation: Situation) -> Decision:
        problem = self.task(situation).problem
        inputs = closed_form(problem)
        cost = float(problem(inputs))
        on_bound = at_bound(problem, inputs)
        return decision(inputs, Certificate(cost, optimal_cost=cost, gap=0.0, at_bound=on_bound))
