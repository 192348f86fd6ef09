"""Since when a vehicle is armed, in the air or down again, and when that disarms it by itself.

Knows time and parameters; whether it stands on the ground it is told, and what disarming does is
for the rules.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from simulator.autopilot.parameters import ParameterTable


@dataclass(slots=True)
class Airtime:
    """Of one vehicle, from arming to disarming."""

    parameters: ParameterTable
    _flown: bool = False
    _armed_s: float = -math.inf
    _landed_s: float = -math.inf

    def arm(self, now_s: float, *, landed: bool) -> None:
        """The motors begin to turn."""
        self._flown, self._armed_s = not landed, now_s

    def disarm(self) -> None:
        self._flown = False

    def step(self, now_s: float, *, was_landed: bool, landed: bool) -> str | None:
        """The event of leaving the ground or touching it."""
        if was_landed and not landed:
            self._flown = True
            return "took off"
        if landed and not was_landed:
            self._landed_s = now_s
            return "landed"
        return None

    def over(self, now_s: float, *, landed: bool) -> str | None:
        """The event of having stood long enough after a flight, or without one."""
        if landed and self._flown:
            return "settled" if self._expired(now_s, self._landed_s, "disarm_landed_s") else None
        if not self._flown:
            return "idle" if self._expired(now_s, self._armed_s, "disarm_idle_s") else None
        return None

    def _expired(self, now_s: float, since_s: float, role: str) -> bool:
        limit_s = self.parameters.role(role)
        return limit_s > 0 and now_s - since_s >= limit_s - 1e-6
