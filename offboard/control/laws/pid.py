"""The cascaded PID law: what most multirotors fly, with our observer and feed-forward.

Position error asks for a velocity, velocity error for an acceleration, its integral takes what the
observer's disturbance leaves. Same target, box and course as the tracking law; no model but the
feed-forward's. Knows no autopilot and reads no clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from offboard.control.base import Certificate, Situation
from offboard.control.certificate import at_bound
from offboard.control.cost import BoxQuadratic
from offboard.control.laws.tracking import OneDecisionSettings, Search, Target, TrackingLaw, errors
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]


class PidSettings(OneDecisionSettings):
    """Gains of the two cascades. `position_gain_ps` turns metres into m/s, `velocity_gain_ps` m/s
    into m/s^2, `integral_gain_ps3` metre seconds into m/s^2; `integral_limit_mps2` bounds the
    integral's part. The defaults are the best of a grid on the PX4-like vehicle. `bandwidth_radps`
    is how fast the loop is with these gains: where the delay bears less, all are lowered with it.
    """

    bandwidth_radps: float = Field(default=5.0, ge=0.5, le=20)
    position_gain_ps: float = Field(default=1.8, ge=0, le=20)
    velocity_gain_ps: float = Field(default=4.6, ge=0, le=50)
    integral_gain_ps3: float = Field(default=0.2, ge=0, le=50)
    height_gain_ps: float = Field(default=3.0, ge=0, le=20)
    climb_gain_ps: float = Field(default=6.0, ge=0, le=50)
    height_integral_gain_ps3: float = Field(default=1.0, ge=0, le=50)
    integral_limit_mps2: float = Field(default=2.0, ge=0, le=10)


class PidLaw(TrackingLaw):
    """The controller `pid`."""

    def __init__(
        self,
        vehicle: Vehicle,
        settings: PidSettings | None = None,
        stopwatch: Callable[[], float] | None = None,
        *,
        period_s: float = 0.1,
    ) -> None:
        self._gains = settings or PidSettings()
        self._integral = np.zeros(3)
        feedforward = self._gains.feedforward
        super().__init__(
            vehicle, self._gains, Search.CLOSED_FORM, stopwatch, feedforward, period_s=period_s
        )

    def adopt(
        self, vehicle: Vehicle, bandwidth_limit_radps: float = math.inf, *, gains: bool = True
    ) -> None:
        super().adopt(vehicle, bandwidth_limit_radps, gains=gains)
        if gains:
            self._slower = min(1.0, bandwidth_limit_radps / self._settings.bandwidth_radps)

    def answer(
        self,
        situation: Situation,
        target: Target,
        problem: BoxQuadratic,
        remaining_s: Callable[[], float] | None,
    ) -> tuple[Array, Certificate]:
        """Feed-forward and the three terms, clipped to the box."""
        gains, state = self._gains, situation.state
        lateral, vertical = errors(state, target)
        upright = float(state.thrust_direction_ned[2])
        asked = np.empty(3)  # acceleration against the error, m/s^2: north, east, down
        slower = self._slower
        lateral_mps = lateral[1] + slower * gains.position_gain_ps * lateral[0]
        climb_mps = vertical[1] + slower * gains.height_gain_ps * vertical[0]
        asked[:2] = slower * gains.velocity_gain_ps * lateral_mps
        asked[2] = slower * gains.climb_gain_ps * climb_mps
        asked += self._integral
        inputs = np.empty(4)
        inputs[0] = (target.thrust_down_feedforward_mps2 + asked[2]) / upright
        inputs[1:3] = target.tilt_feedforward + asked[:2] / self._vehicle.gravity_mps2
        inputs[3] = target.course_feedforward_rad
        clipped: Array = np.clip(inputs, problem.lower, problem.upper)
        free = clipped == inputs
        self._integrate(np.append(lateral[0], vertical[0]), free[[1, 2, 0]])
        certificate = Certificate(cost=float(problem(clipped)), at_bound=at_bound(problem, clipped))
        return clipped, certificate

    def reset(self) -> None:
        """Forget everything of the previous flight, the integral included."""
        super().reset()
        self._integral = np.zeros(3)

    def _integrate(self, off_ned_m: Array, free: NDArray[np.bool_]) -> None:
        """Only axes whose command is not on its bound: what winds up there overshoots later."""
        gains = self._gains
        rates = np.array([gains.integral_gain_ps3] * 2 + [gains.height_integral_gain_ps3])
        step = self._slower**3 * self._period_s * rates * off_ned_m
        limit = gains.integral_limit_mps2
        self._integral = np.clip(
            np.where(free, self._integral + step, self._integral), -limit, limit
        )
