"""The autopilot's own position loop as a controller: it is given the reference and nothing else.

What a user has without this package: position, velocity and acceleration, each decision anew.
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from offboard.control.base import Decision, DecisionError, Situation
from offboard.documents.parameters import Parameters
from offboard.model.command import PositionCommand
from offboard.model.frames import wrap_pi


class AutopilotSettings(Parameters):
    """`lead_s`: how far ahead of now the reference is taken, beyond half a period for the hold."""

    lead_s: float = Field(default=0.0, ge=0, le=1)


class AutopilotLaw:
    """The controller `autopilot`."""

    def __init__(self, settings: AutopilotSettings | None = None, *, period_s: float = 0.1) -> None:
        settings = settings or AutopilotSettings()
        self._ahead_s = settings.lead_s + 0.5 * period_s

    def decide(self, situation: Situation) -> Decision:
        """The reference as it will be. Raises DecisionError where it is not finite."""
        sample = situation.reference.sample(situation.time_s + self._ahead_s)
        vectors = (sample.position_ned_m, sample.velocity_ned_mps, sample.acceleration_ned_mps2)
        if not (np.isfinite(vectors).all() and math.isfinite(float(sample.course_rad))):
            raise DecisionError("the reference is not finite")
        position, velocity, acceleration = (
            (float(vector[0]), float(vector[1]), float(vector[2])) for vector in vectors
        )
        return Decision(
            PositionCommand(
                position,
                velocity,
                acceleration,
                wrap_pi(float(sample.course_rad)),
                float(sample.course_rate_radps),
            )
        )

    def reset(self) -> None:
        """There is nothing to forget."""
