"""Trajectory to a goal in automatic flight, smooth where the firmware plans it so (PX4).

A point (`simulator.autopilot.smoothing`) flies ahead of the vehicle and stops at the goal; its
motion is the setpoint of the position loop. Knows places, speeds and limits; knows no modes and no
thrust.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.smoothing import Point, Target
from simulator.autopilot.state import StateEstimate
from simulator.firmware.base import PathLimits
from simulator.firmware.values import NAN3, MotionSetpoint, ReadParameter, Triple

_ARRIVED_M, _ARRIVED_MPS = 0.02, 0.02  # nearer and slower: the point is at the goal
_ON_GROUND_MPS = 0.7  # descent with which a point starts on the ground
_CLIMBS_MPS = 0.3
_REACTION_S = 0.6  # lost to the jerk when braking
_ZERO: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Leg:
    """One leg of a flight: the places (NED, m) before and after its goal, or NaN; the speed across
    the ground; the radius of acceptance, or NaN; whether it is a takeoff; the height above home."""

    cruise_mps: float
    previous_ned_m: Triple = NAN3
    following_ned_m: Triple = NAN3
    acceptance_m: float = math.nan
    takeoff: bool = False
    height_m: float = math.inf


class Trajectory:
    """Trajectory of one vehicle. `active`: it is flown, from goal to goal."""

    def __init__(
        self, limits: Callable[[ReadParameter], PathLimits], parameters: ParameterTable
    ) -> None:
        self._read_limits, self._parameters = limits, parameters
        self.active = False
        self._point = Point()
        self._resets = 0  # of the estimate
        self._tune()

    def _tune(self) -> None:
        self._tuned = self._parameters.changes
        self.limits = self._read_limits(self._parameters.__getitem__)

    @property
    def climbs(self) -> bool:
        """The goal is above."""
        return self._point.goal_ned_mps[2] < -_CLIMBS_MPS

    def stop_ned_m(self, estimate: StateEstimate) -> Triple:
        """Where a vehicle stops that brakes now, as PX4 predicts it."""
        (x, y, z), (vx, vy, _) = estimate.position_ned_m, estimate.velocity_ned_mps
        time_s = _REACTION_S + 0.5 * math.hypot(vx, vy) / self.limits.across_mps2
        return (x + time_s * vx, y + time_s * vy, z)

    def follow(
        self, goal: MotionSetpoint, leg: Leg, estimate: StateEstimate, *, on_ground: bool
    ) -> MotionSetpoint:
        """Motion of one period on the leg to this goal: a place, or one to descend at with a speed.

        The trajectory starts at the estimate; again in each period `on_ground`, where the vehicle
        may not lift off yet.
        """
        if self._tuned != self._parameters.changes:
            self._tune()
        point = self._point
        if on_ground or not self.active:
            velocity = (0.0, 0.0, _ON_GROUND_MPS) if on_ground else estimate.velocity_ned_mps
            point.start(estimate.position_ned_m, velocity)
        elif estimate.reset_counter != self._resets:
            point.move_to(estimate.position_ned_m)
        self.active, self._resets = True, estimate.reset_counter
        target = self._target(goal, leg)
        point.follow(target, self.limits, estimate.position_ned_m)
        yaw_rad = goal.yaw_rad
        if self._has_arrived(goal):
            point.start(goal.position_ned_m, _ZERO)
        elif math.isnan(yaw_rad) and goal.faces_way:
            yaw_rad = _heading(goal, estimate, target.acceptance_m)
        motion = (point.position_ned_m, point.velocity_ned_mps, point.acceleration_ned_mps2)
        return MotionSetpoint(*motion, yaw_rad, turn_radps=goal.turn_radps)

    def _target(self, goal: MotionSetpoint, leg: Leg) -> Target:
        """Target of this period, with the speeds of a climb, a descent or a takeoff."""
        limits, place = self.limits, goal.position_ned_m
        climbs = self._point.goal_ned_mps[2] < 0.0
        takes_off = climbs and leg.takeoff and leg.height_m < limits.lift_below_m
        speed_mps, rate_mps2 = limits.speed_down_mps, limits.down_mps2
        if climbs:
            speed_mps, rate_mps2 = limits.speed_up_mps, limits.up_mps2
        if takes_off:
            speed_mps, rate_mps2 = limits.lift_mps, min(rate_mps2, limits.lift_mps2)
        return Target(
            place=place,
            previous=leg.previous_ned_m,
            following=leg.following_ned_m,
            descent_mps=goal.velocity_ned_mps[2],
            follows_height=takes_off,
            cruise_mps=min(leg.cruise_mps, limits.speed_across_mps),
            speed_z_mps=speed_mps,
            acceleration_z_mps2=rate_mps2,
            acceptance_m=limits.accepted_m if math.isnan(leg.acceptance_m) else leg.acceptance_m,
        )

    def _has_arrived(self, goal: MotionSetpoint) -> bool:
        """The point is at the goal; never while it descends to a height that is NaN."""
        gap_m = math.dist(goal.position_ned_m, self._point.position_ned_m)
        return gap_m < _ARRIVED_M and math.hypot(*self._point.velocity_ned_mps) < _ARRIVED_MPS


def _heading(goal: MotionSetpoint, estimate: StateEstimate, acceptance_m: float) -> float:
    """Yaw to the goal; NaN near it, which keeps the present yaw."""
    north = goal.position_ned_m[0] - estimate.position_ned_m[0]
    east = goal.position_ned_m[1] - estimate.position_ned_m[1]
    return math.atan2(east, north) if math.hypot(north, east) > acceptance_m else math.nan
