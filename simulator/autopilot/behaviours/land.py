"""Land: descend where the vehicle is, slower near the ground."""

from __future__ import annotations

import math

from simulator.autopilot.behaviours.base import ActiveBehaviour
from simulator.autopilot.nav import Nav
from simulator.autopilot.parameters import ParameterTable
from simulator.firmware.values import MotionSetpoint, Triple


class Land(ActiveBehaviour):
    """PX4 AUTO.LAND; ArduCopter LAND."""

    @property
    def landing(self) -> bool:
        return True

    def motion(self, nav: Nav, time_s: float, *, landed: bool) -> MotionSetpoint:
        guidance = self.guidance
        speed_mps = land_speed_mps(nav, guidance.home_ned_m[2], guidance.parameters)
        return sink(guidance.hold_ned_m, speed_mps)


def sink(place_ned_m: Triple, speed_mps: float, yaw_rad: float = math.nan) -> MotionSetpoint:
    """Straight down at this speed."""
    down = (math.nan, math.nan, speed_mps)
    return MotionSetpoint((place_ned_m[0], place_ned_m[1], math.nan), down, yaw_rad=yaw_rad)


def land_speed_mps(nav: Nav, home_down_m: float, parameters: ParameterTable) -> float:
    """Descent speed: slower towards home's height, slowest where the range finder sees the ground
    (PX4 MPC_LAND_SPEED, MPC_LAND_CRWL; ArduCopter LAND_SPEED)."""
    role = parameters.role
    slow = role("land_speed_mps")
    if nav.ground_m <= role("crawl_below_m"):
        return min(slow, role("crawl_speed_mps"))
    fast = max(slow, role("descent_speed_mps"))
    slow_below_m, fast_above_m = role("slow_below_m"), role("fast_above_m")
    height_m = home_down_m - nav.position_ned_m[2]
    share = (height_m - slow_below_m) / max(fast_above_m - slow_below_m, 1e-3)
    return slow + min(1.0, max(0.0, share)) * (fast - slow)
