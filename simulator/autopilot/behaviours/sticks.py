"""Sticks: move as the sticks ask; without sticks descend slowly."""

from __future__ import annotations

import math

from simulator.autopilot.behaviours.base import ActiveBehaviour
from simulator.autopilot.behaviours.land import sink
from simulator.autopilot.nav import Nav
from simulator.firmware.values import NAN3, MotionSetpoint, Triple

_STILL_MPS = 0.05  # a slower demand holds the place


class FlyBySticks(ActiveBehaviour):
    """ArduCopter LOITER, ALT_HOLD and POSHOLD; PX4 POSCTL and ALTCTL, whose sticks are centred low:
    the vehicle descends."""

    lifts_off = True
    planned = False

    def enter(self, nav: Nav, place_ned_m: Triple = NAN3) -> None:
        if self.guidance.sticks is not None:
            self.guidance.sticks.begin()

    def motion(self, nav: Nav, time_s: float, *, landed: bool) -> MotionSetpoint:
        """The velocity that the sticks ask for; an axis that none of them moves holds its place."""
        guidance = self.guidance
        descend_mps = guidance.firmware.flight.descend_speed_mps
        if guidance.sticks is None:
            return sink(guidance.hold_ned_m, descend_mps)
        across, change, climb_mps, turn_radps = guidance.sticks.ask(time_s, nav.yaw_rad)
        if landed and climb_mps <= 0.0:
            return sink(guidance.hold_ned_m, descend_mps)
        (x, y, z), stop = guidance.hold_ned_m, guidance.stopping_place_ned_m(nav)
        moves = math.hypot(*across) > _STILL_MPS
        x, y = stop[:2] if moves else (x, y)
        guidance.hold_ned_m = (x, y, stop[2] if climb_mps else z)
        nothing = (math.nan, math.nan)
        return MotionSetpoint(
            (*(nothing if moves else (x, y)), math.nan if climb_mps else z),
            (*(across if moves else nothing), -climb_mps or math.nan),
            (*(change if moves else nothing), math.nan),
            yaw_rate_radps=turn_radps or math.nan,
        )
