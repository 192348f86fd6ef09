"""Leaving the ground: the motors spool up, then the climb rate allowed rises until it lifts.

The rate begins where the position loop gives no thrust at all, so thrust rises from nothing.
Knows time and parameters; knows no modes and no position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.position_law import GRAVITY_MPS2


@dataclass(slots=True)
class Takeoff:
    """`spooling`, then ready on the ground, then `lifting` for the length of the ramp."""

    parameters: ParameterTable
    _spool_left_s: float = 0.0
    _ramp_s: float = 0.0
    _flying: bool = False

    @property
    def spooling(self) -> bool:
        return self._spool_left_s > 0.0

    @property
    def flying(self) -> bool:
        """The takeoff is over."""
        return self._flying

    @property
    def lifting(self) -> bool:
        """On the ramp, on the ground or just off it."""
        return not self._flying and self._ramp_s > 0.0

    def arm(self) -> None:
        """The motors begin to turn."""
        self._spool_left_s = self.parameters.role("spool_up_s")
        self._ramp_s, self._flying = 0.0, False

    def land(self) -> None:
        """Down, with the motors turning."""
        self._ramp_s, self._flying = 0.0, False

    def fly(self) -> None:
        """In the air by other means."""
        self._spool_left_s, self._flying = 0.0, True

    def step(self, duration_s: float, wants_up: bool) -> None:
        """Move on by one period; `wants_up`: there is somewhere to climb to."""
        if self.spooling:
            self._spool_left_s -= duration_s
        elif not self._flying and (wants_up or self._ramp_s > 0.0):
            self._ramp_s += duration_s
            self._flying = self._ramp_s >= self.parameters.role("takeoff_ramp_s")

    def speed_up_mps(self, velocity_p_ps: float) -> float:
        """The climb rate allowed, which is one of descent at first."""
        if self._flying:
            return math.inf
        none_mps = -GRAVITY_MPS2 / velocity_p_ps
        share = min(1.0, self._ramp_s / max(self.parameters.role("takeoff_ramp_s"), 1e-3))
        return none_mps + share * (self.parameters.role("ramp_ends_mps") - none_mps)
