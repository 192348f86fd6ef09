"""The law `mpc`: the cost of the tracking laws over N decisions within their bounds, by daqp.

Where no later bound is active it equals `lqr`; where one is, it plans for it. It avoids no keep-out
volume.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from offboard.control.base import Certificate, Decision, DecisionError, Situation
from offboard.control.horizon.outlook import HorizonQuadratic, bounds, look_ahead
from offboard.control.law import TrackingLaw, TrackingSettings, decision
from offboard.control.quadratic import ExactMinimum, at_bound
from offboard.model.vehicle import Vehicle


class MpcSettings(TrackingSettings):
    """Settings of the law `mpc`; `steps` is the number of decisions planned."""

    law: Literal["mpc"] = "mpc"
    steps: int = Field(default=10, ge=2, le=40)

    def build(self, vehicle: Vehicle, *, period_s: float, seed: int) -> MpcLaw:
        return MpcLaw(vehicle, self, period_s=period_s)


class MpcLaw(TrackingLaw):
    """Linear model predictive control."""

    def __init__(self, vehicle: Vehicle, settings: MpcSettings, *, period_s: float = 0.1) -> None:
        self._steps = settings.steps
        super().__init__(vehicle, settings, period_s)
        self._exact = ExactMinimum(3 * self._steps)

    def decide(self, situation: Situation) -> Decision:
        task = self.task(situation)
        ahead = look_ahead(self, situation, self._steps)
        planned = self._quadratic.problem(task, bounds(ahead, task, self))
        best = self._exact.minimise(planned)
        if not np.isfinite(best).all():
            raise DecisionError("the quadratic over the horizon has no solution")
        cost = float(planned(best))
        certificate = Certificate(
            cost, optimal_cost=cost, gap=0.0, at_bound=at_bound(planned, best)
        )
        inputs = task.inputs(self._quadratic.plan(best)[0])
        return decision(task.problem.clip(inputs), certificate)

    def _use_gains(self, bandwidth_radps: float) -> None:
        super()._use_gains(bandwidth_radps)
        self._quadratic = HorizonQuadratic(self, self._steps)
