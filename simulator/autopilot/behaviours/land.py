"""Land: descend vertically, slower near the ground."""

from __future__ import annotations

import math

from simulator.autopilot.behaviours.base import ActiveBehaviour
from simulator.autopilot.guidance import Guidance
from simulator.autopilot.state import StateEstimate
from simulator.firmware.values import MotionSetpoint, Triple


class Land(ActiveBehaviour):
    """PX4 AUTO.LAND; ArduCopter LAND."""

    landing = True

    def motion(self, estimate: StateEstimate, *, landed: bool) -> MotionSetpoint:
        guidance = self.guidance
        return descent(guidance.hold_ned_m, land_speed_mps(estimate, guidance))


def descent(place_ned_m: Triple, speed_mps: float, yaw_rad: float = math.nan) -> MotionSetpoint:
    """Vertically down at this speed."""
    north, east, _ = place_ned_m
    velocity = (math.nan, math.nan, speed_mps)
    return MotionSetpoint((north, east, math.nan), velocity, yaw_rad=yaw_rad)


def land_speed_mps(estimate: StateEstimate, guidance: Guidance) -> float:
    """Descent speed: slower towards home's height, slowest where the range finder sees the ground
    (PX4 MPC_LAND_SPEED, MPC_LAND_CRWL; ArduCopter LAND_SPEED)."""
    role = guidance.parameters.role
    slow = role("land_speed_mps")
    if estimate.ground_m <= role("crawl_below_m"):
        return min(slow, role("crawl_speed_mps"))
    fast = max(slow, role("descent_speed_mps"))
    slow_below_m, fast_above_m = role("slow_below_m"), role("fast_above_m")
    height_m = guidance.home_ned_m[2] - estimate.position_ned_m[2]
    share = (height_m - slow_below_m) / max(fast_above_m - slow_below_m, 1e-3)
    return slow + min(1.0, max(0.0, share)) * (fast - slow)
