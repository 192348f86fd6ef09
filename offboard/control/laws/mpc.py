"""The linear predictive law: the tracking law's cost over N decisions in their boxes, by daqp.

Where no later bound is active it is the closed form of `lqr`; where one is, it sees it coming.
Knows no keep-out volume.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from offboard.control.base import Certificate, DecisionError, Situation
from offboard.control.certificate import ExactMinimum, at_bound
from offboard.control.cost import BoxQuadratic
from offboard.control.horizon.outlook import bounds, look_ahead
from offboard.control.horizon.quadratic import HorizonQuadratic
from offboard.control.laws.tracking import Search, Target, TrackingLaw, TrackingSettings, errors
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]


class MpcSettings(TrackingSettings):
    """The tracking law's settings and the number of decisions planned."""

    steps: int = Field(default=10, ge=2, le=40)


class MpcLaw(TrackingLaw):
    """The controller `mpc`."""

    def __init__(
        self,
        vehicle: Vehicle,
        settings: MpcSettings | None = None,
        stopwatch: Callable[[], float] | None = None,
        *,
        period_s: float = 0.1,
    ) -> None:
        self._steps = (settings or MpcSettings()).steps
        self._planner = ExactMinimum(3 * self._steps)
        super().__init__(
            vehicle, settings or MpcSettings(), Search.CLOSED_FORM, stopwatch, period_s=period_s
        )

    def adopt(
        self, vehicle: Vehicle, bandwidth_limit_radps: float = math.inf, *, gains: bool = True
    ) -> None:
        super().adopt(vehicle, bandwidth_limit_radps, gains=gains)
        if gains:
            self._quadratic = HorizonQuadratic(self.lateral, self.vertical, self._steps)

    def answer(
        self,
        situation: Situation,
        target: Target,
        problem: BoxQuadratic,
        remaining_s: Callable[[], float] | None,
    ) -> tuple[Array, Certificate]:
        """The first input of the exact plan."""
        state, settings = situation.state, self._settings
        upright = float(state.thrust_direction_ned[2])
        ahead = look_ahead(self._vehicle, situation.reference, state, self._period_s, self._steps)
        limit = min(settings.tilt_limit, math.sin(self._vehicle.tilt_max_rad))
        thrusts = (float(problem.lower[0]), float(problem.upper[0]))
        within = bounds(ahead, upright, limit, settings.feedback_limit, thrusts)
        planned = self._quadratic.problem(*errors(state, target), within)
        best = self._planner.minimise(planned)
        if not np.isfinite(best).all():
            raise DecisionError("the quadratic over the horizon has no solution")
        first = self._quadratic.plan(best)[0]
        cost = float(planned(best))
        certificate = Certificate(
            cost=cost, optimal_cost=cost, gap=0.0, at_bound=at_bound(planned, best)
        )
        return one_decision(first, upright, target, problem), certificate


def one_decision(first: Array, upright: float, target: Target, problem: BoxQuadratic) -> Array:
    """The input (4,) of the first step's deviations [north, east, down], within the box."""
    inputs = np.empty(4)
    inputs[0] = (target.thrust_down_feedforward_mps2 + first[2]) / upright
    inputs[1:3] = target.tilt_feedforward + first[:2]
    inputs[3] = target.course_feedforward_rad
    clipped: Array = np.clip(inputs, problem.lower, problem.upper)
    return clipped
