"""Sticks: fly the velocity that the sticks demand; without sticks descend slowly."""

from __future__ import annotations

import math

from simulator.autopilot.behaviours.base import ActiveBehaviour
from simulator.autopilot.behaviours.land import descent
from simulator.autopilot.state import StateEstimate
from simulator.firmware.values import MotionSetpoint, Triple

_STILL_MPS = 0.05  # a slower demand holds the place


class FlyBySticks(ActiveBehaviour):
    """ArduCopter LOITER, ALT_HOLD and POSHOLD; PX4 POSCTL and ALTCTL, which have no stick input
    here: the vehicle descends."""

    lifts_off = True
    planned = False

    def enter(self, estimate: StateEstimate, place_ned_m: Triple, *, landed: bool) -> None:
        if self.guidance.sticks is not None:
            self.guidance.sticks.begin()

    def motion(self, estimate: StateEstimate, *, landed: bool) -> MotionSetpoint:
        """The velocity demanded; an axis without a demand holds its place."""
        guidance = self.guidance
        descend = descent(guidance.hold_ned_m, guidance.firmware.flight.descend_speed_mps)
        if guidance.sticks is None:
            return descend
        demand = guidance.sticks.demand(estimate.time_s, estimate.yaw_rad)
        velocity, acceleration, climb_mps, turn_radps = demand
        if landed and climb_mps <= 0.0:
            return descend
        (x, y, z), stop = guidance.hold_ned_m, guidance.stopping_place_ned_m(estimate)
        moves = math.hypot(*velocity) > _STILL_MPS
        x, y = stop[:2] if moves else (x, y)
        guidance.hold = MotionSetpoint((x, y, stop[2] if climb_mps else z))
        none = (math.nan, math.nan)
        return MotionSetpoint(
            (*(none if moves else (x, y)), math.nan if climb_mps else z),
            (*(velocity if moves else none), -climb_mps or math.nan),
            (*(acceleration if moves else none), math.nan),
            yaw_rate_radps=turn_radps or math.nan,
        )
