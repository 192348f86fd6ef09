"""Takeoff: climb to a place, or vertically to the default height."""

from __future__ import annotations

import math

from simulator.autopilot.behaviours.base import ActiveBehaviour
from simulator.autopilot.state import StateEstimate
from simulator.firmware.values import Behaviour, MotionSetpoint, Triple

_FLATTEST = 1000.0  # m across per m of climb


class Takeoff(ActiveBehaviour):
    """PX4 AUTO.TAKEOFF; ArduCopter GUIDED after MAV_CMD_NAV_TAKEOFF. Reports "climbed"."""

    lifts_off = True
    climbing = True
    _climbed = False

    def enter(self, estimate: StateEstimate, place_ned_m: Triple, *, landed: bool) -> None:
        """Choose the height. Neither a descent nor, on the ground, a nearly flat leg is flown."""
        (x, y, z), (north, east, target_z) = estimate.position_ned_m, place_ned_m
        if math.isnan(target_z):
            target_z = z - self.guidance.parameters.role("takeoff_height_m")
            self.guidance.events.append("default height")
        elif target_z > z:
            target_z, self.cannot_climb = z, landed
            self.guidance.events.append("already higher")
        if landed and math.hypot(north - x, east - y) > _FLATTEST * (z - target_z):
            self.cannot_climb = True
        self._place_ned_m = (north, east, target_z)

    def keeps_place(self, following: Behaviour) -> bool:
        return self._climbed and following in (Behaviour.HOLD, Behaviour.SETPOINT)

    def motion(self, estimate: StateEstimate, *, landed: bool) -> MotionSetpoint:
        guidance = self.guidance
        north, east, target_z = self._place_ned_m
        if math.isnan(north + east):
            north, east = guidance.hold_ned_m[:2]
        within_m = guidance.parameters.role("climbed_within_m")
        if not (self._climbed or landed) and estimate.position_ned_m[2] < target_z + within_m:
            self._climbed = True
            guidance.events.append("climbed")
        guidance.hold = MotionSetpoint((north, east, target_z))
        return guidance.hold
