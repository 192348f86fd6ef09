"""The law `autopilot`: sends the reference to the autopilot's own position loop.

It serves as a comparison, because position, velocity and acceleration can be sent without this
package.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

from pydantic import Field

from offboard.control.base import ControllerSettings, Decision, DecisionError, Situation
from offboard.model.frames import wrap_pi
from offboard.model.vehicle import Vehicle


class AutopilotSettings(ControllerSettings):
    """Settings of the law `autopilot`. The reference is sampled `lead_s` after the tick, plus half
    a period because the setpoint is held for one period."""

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
        setpoint = sample.setpoint()
        if not all(map(math.isfinite, setpoint.numbers())):
            raise DecisionError("the reference is not finite")
        return Decision(replace(setpoint, heading_rad=wrap_pi(setpoint.heading_rad)))

    def reset(self) -> None:
        """Nothing to do: the law has no state."""
