"""The law `pid`: cascaded loops as on most multirotors, with our observer and feed-forward.

The position loop commands a velocity, the velocity loop an acceleration; an integral removes the
steady error that the compensation of the estimated disturbance leaves.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from offboard.control.base import Certificate, Decision, Situation
from offboard.control.law import TrackingLaw, TrackingSettings, decision
from offboard.control.quadratic import at_bound
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]


class PidSettings(TrackingSettings):
    """Settings of the law `pid`: the gains of the two cascades. The defaults are the best of a grid
    search on the PX4-like vehicle.

    `position_gain_ps` turns m into m/s, `velocity_gain_ps` m/s into m/s^2, `integral_gain_ps3` m s
    into m/s^2; `integral_limit_mps2` bounds the integral. `bandwidth_radps` is the bandwidth of the
    loop with these gains; if the delay supports only a lower one, all gains are lowered with it.
    """

    law: Literal["pid"] = "pid"
    bandwidth_radps: float = Field(default=5.0, ge=0.5, le=20)
    position_gain_ps: float = Field(default=1.8, ge=0, le=20)
    velocity_gain_ps: float = Field(default=4.6, ge=0, le=50)
    integral_gain_ps3: float = Field(default=0.2, ge=0, le=50)
    height_gain_ps: float = Field(default=3.0, ge=0, le=20)
    climb_gain_ps: float = Field(default=6.0, ge=0, le=50)
    height_integral_gain_ps3: float = Field(default=1.0, ge=0, le=50)
    integral_limit_mps2: float = Field(default=2.0, ge=0, le=10)

    def build(self, vehicle: Vehicle, *, period_s: float, seed: int) -> PidLaw:
        return PidLaw(vehicle, self, period_s=period_s)


class PidLaw(TrackingLaw):
    """Proportional, integral and derivative action on the position error."""

    def __init__(self, vehicle: Vehicle, settings: PidSettings, *, period_s: float = 0.1) -> None:
        super().__init__(vehicle, settings, period_s)
        self._gains = settings
        self._integral = np.zeros(3)  # m/s^2, NED

    def decide(self, situation: Situation) -> Decision:
        problem, gains = self.problem(situation), self._gains
        slower, slower_climb = self._slower
        lateral, vertical = problem.at_hover, problem.vertical
        north_east_mps = lateral[1] + slower * gains.position_gain_ps * lateral[0]
        climb_mps = vertical[1] + slower_climb * gains.height_gain_ps * vertical[0]
        asked = np.empty(3)  # acceleration against the error, NED; lateral as in hover
        asked[:2] = slower * gains.velocity_gain_ps * north_east_mps
        asked[2] = slower_climb * gains.climb_gain_ps * climb_mps
        asked[:2] += self._integral[:2] @ problem.target.to_hover
        asked[2] += self._integral[2]
        asked[:2] /= self.vehicle.gravity_mps2  # converted to tilt
        inputs = problem.inputs(asked)
        clipped = problem.quadratic.clip(inputs)
        self._integrate(np.append(problem.lateral[0], vertical[0]), (clipped == inputs)[[1, 2, 0]])
        cost, on_bound = float(problem.quadratic(clipped)), at_bound(problem.quadratic, clipped)
        return decision(clipped, Certificate(cost, at_bound=on_bound))

    def reset(self) -> None:
        super().reset()
        self._integral = np.zeros(3)

    @property
    def _slower(self) -> tuple[float, float]:
        """Factors of the lateral gains and of those of the height, because of the delay."""
        lateral_radps, vertical_radps = self.bandwidth
        return lateral_radps / self.configured_radps, vertical_radps / self.configured_radps

    def _integrate(self, off_ned_m: Array, free: NDArray[np.bool_]) -> None:
        """Integrate the error of the axes whose command is not at its bound (anti-windup)."""
        gains, (slower, slower_climb) = self._gains, self._slower
        lateral = slower**3 * gains.integral_gain_ps3
        rates = np.array((lateral, lateral, slower_climb**3 * gains.height_integral_gain_ps3))
        step = self.period_s * rates * off_ned_m
        limit = gains.integral_limit_mps2
        self._integral = np.clip(
            np.where(free, self._integral + step, self._integral), -limit, limit
        )
