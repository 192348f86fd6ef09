"""The law `autopilot`: the autopilot's own position loop, which is sent the reference.

For comparison: a user can send position, velocity and acceleration without this package.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from pydantic import Field

from offboard.control.base import ControllerSettings, Decision, DecisionError, Situation
from offboard.model.command import PositionCommand
from offboard.model.frames import wrap_pi
from offboard.model.vehicle import Vehicle


class AutopilotSettings(ControllerSettings):
    """Settings of the law `autopilot`. The reference is sampled `lead_s` ahead of the tick, plus
    half a period because the setpoint is held for one."""

    law: Literal["autopilot"] = "autopilot"
    lead_s: float = Field(default=0.0, ge=0, le=1)

    def build(self, vehicle: Vehicle, *, period_s: float, seed: int) -> AutopilotLaw:
        return AutopilotLaw(self, period_s=period_s)


class AutopilotLaw:
    """Sends the reference as position setpoints."""

    def __init__(self, settings: AutopilotSettings, *, period_s: float = 0.1) -> None:
        self._ahead_s = settings.lead_s + 0.5 * period_s

    def decide(self, situation: Situation) -> Decision:
        sample = situation.reference.sample(situation.time_s + self._ahead_s)
        vectors = (sample.position_ned_m, sample.velocity_ned_mps, sample.acceleration_ned_mps2)
        if not (np.isfinite(vectors).all() and math.isfinite(float(sample.heading_rad))):
            raise DecisionError("the reference is not finite")
        position, velocity, acceleration = (
            (float(vector[0]), float(vector[1]), float(vector[2])) for vector in vectors
        )
        return Decision(
            PositionCommand(
                position,
                velocity,
                acceleration,
                wrap_pi(float(sample.heading_rad)),
                float(sample.heading_rate_radps),
            )
        )

    def reset(self) -> None:
        """Nothing to do: the law has no state."""
