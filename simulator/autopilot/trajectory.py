"""The way to a goal in automatic flight, smooth where the firmware plans it so (PX4).

A point (`simulator.autopilot.smoothing`) flies ahead of the vehicle and comes to rest at the goal;
its motion is the setpoint of the position loop. Knows places, speeds and limits; knows no modes and
no thrust.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from simulator.autopilot.nav import Nav
from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.smoothing import Point, Target
from simulator.firmware.base import PathLimits
from simulator.firmware.values import NAN3, MotionSetpoint, ReadParameter, Triple

_RESTS_M, _RESTS_MPS = 0.02, 0.02  # nearer and slower than that it has arrived
_STARTS_DOWN_MPS = 0.7  # on the ground: a takeoff begins by pressing on it
_WANTS_UP_MPS = 0.3
_DECIDES_S = 0.6  # lost to the jerk when braking
_STILL: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Leg:
    """One leg: the places (NED, m) before and after its goal, or NaN; the speed across the ground;
    the radius of acceptance, or NaN; whether it is a takeoff; the height above home."""

    cruise_mps: float
    before_ned_m: Triple = NAN3
    behind_ned_m: Triple = NAN3
    accepted_m: float = math.nan
    takeoff: bool = False
    height_m: float = math.inf


class Trajectory:
    """Way of one vehicle. `under_way`: it is being followed, from goal to goal."""

    def __init__(
        self, limits: Callable[[ReadParameter], PathLimits], parameters: ParameterTable
    ) -> None:
        self._read, self._parameters = limits, parameters
        self.under_way = False
        self._point = Point()
        self._resets = 0
        self._goal: MotionSetpoint | None = None
        self._rest: MotionSetpoint | None = None
        self._tune()

    def _tune(self) -> None:
        """Read the limits from the parameters."""
        self._tuned = self._parameters.changes
        self.limits = self._read(self._parameters.__getitem__)

    @property
    def wants_up(self) -> bool:
        """The goal is above."""
        return self._point.wanted_ned_mps[2] < -_WANTS_UP_MPS

    def stop_ned_m(self, nav: Nav) -> Triple:
        """Where a vehicle that flies so can hold, as PX4 foresees its braking."""
        (x, y, z), (vx, vy, _) = nav.position_ned_m, nav.velocity_ned_mps
        brakes_s = _DECIDES_S + 0.5 * math.hypot(vx, vy) / self.limits.across_mps2
        return (x + brakes_s * vx, y + brakes_s * vy, z)

    def leave(self) -> None:
        """Something else is flown; the next way begins with the vehicle's own motion."""
        self.under_way = False

    def _start(self, nav: Nav, velocity_ned_mps: Triple) -> None:
        self._point.stand(nav.position_ned_m, velocity_ned_mps)
        self._goal = self._rest = None
        self._resets = nav.reset_counter

    def follow(self, goal: MotionSetpoint, leg: Leg, nav: Nav, *, waits: bool) -> MotionSetpoint:
        """Motion of one period. The goal is a place, or one to sink at with a speed. `waits`: the
        vehicle stands on the ground and may not lift off yet."""
        if self._tuned != self._parameters.changes:
            self._tune()
        if waits:
            self._start(nav, (0.0, 0.0, _STARTS_DOWN_MPS))
        elif not self.under_way:
            self._start(nav, nav.velocity_ned_mps)
        self.under_way = True
        if nav.reset_counter != self._resets:
            self._resets, self._rest = nav.reset_counter, None
            self._point.move_to(nav.position_ned_m)
        if goal is not self._goal:
            self._goal, self._rest = goal, None
        if self._rest is not None:
            return self._rest
        target, point = self._target(goal, leg), self._point
        point.follow(target, self.limits, nav.position_ned_m)
        if self._has_arrived(goal):
            point.stand(goal.position_ned_m, _STILL)
            self._rest = MotionSetpoint(
                goal.position_ned_m, _STILL, _STILL, goal.yaw_rad, turn_radps=goal.turn_radps
            )
            return self._rest
        yaw_rad = goal.yaw_rad
        if math.isnan(yaw_rad) and goal.faces_way:
            yaw_rad = _heading(goal, nav, target.accepted_m)
        motion = (point.position_ned_m, point.velocity_ned_mps, point.acceleration_ned_mps2)
        return MotionSetpoint(*motion, yaw_rad, turn_radps=goal.turn_radps)

    def _target(self, goal: MotionSetpoint, leg: Leg) -> Target:
        """Target of this period, with the speeds of a climb, a descent or a takeoff."""
        limits, place = self.limits, goal.position_ned_m
        rises = self._point.wanted_ned_mps[2] < 0.0
        lifts = rises and leg.takeoff and leg.height_m < limits.lift_below_m
        speed_mps, rate_mps2 = limits.speed_down_mps, limits.down_mps2
        if rises:
            speed_mps, rate_mps2 = limits.speed_up_mps, limits.up_mps2
        if lifts:
            speed_mps, rate_mps2 = limits.lift_mps, min(rate_mps2, limits.lift_mps2)
        return Target(
            place=place,
            before=place if math.isnan(leg.before_ned_m[0]) else leg.before_ned_m,
            after=place if math.isnan(leg.behind_ned_m[0]) else leg.behind_ned_m,
            sink_mps=goal.velocity_ned_mps[2],
            follows_height=lifts,
            cruise_mps=min(leg.cruise_mps, limits.speed_across_mps),
            speed_z_mps=speed_mps,
            acceleration_z_mps2=rate_mps2,
            accepted_m=limits.accepted_m if math.isnan(leg.accepted_m) else leg.accepted_m,
        )

    def _has_arrived(self, goal: MotionSetpoint) -> bool:
        """The point is at the goal; never while it sinks."""
        gap_m = math.dist(goal.position_ned_m, self._point.position_ned_m)
        return gap_m < _RESTS_M and math.hypot(*self._point.velocity_ned_mps) < _RESTS_MPS


def _heading(goal: MotionSetpoint, nav: Nav, accepted_m: float) -> float:
    """Yaw to the goal; NaN near it, which keeps the present yaw."""
    north = goal.position_ned_m[0] - nav.position_ned_m[0]
    east = goal.position_ned_m[1] - nav.position_ned_m[1]
    return math.atan2(east, north) if math.hypot(north, east) > accepted_m else math.nan
