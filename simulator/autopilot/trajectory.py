"""The way to a goal in automatic flight, smooth where the firmware draws it so (PX4).

A point runs ahead of the vehicle and comes to rest at the goal; its motion is what the position
loop flies. Knows places, speeds and limits; knows no modes and no thrust.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from offboard.model.kernel import address
from simulator.autopilot.nav import Nav
from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.smoothing import RECORD, follow
from simulator.firmware.flight import PathLimits
from simulator.firmware.setpoints import MotionSetpoint
from simulator.firmware.vocabulary import NAN3, ReadParameter, Triple
from simulator.steps import LOOP_S

_RESTS_M, _RESTS_MPS = 0.02, 0.02  # nearer and slower than that it has arrived
_STARTS_DOWN_MPS = 0.7  # on the ground: a takeoff begins by pressing on it
_WANTS_UP_MPS = 0.3
_DECIDES_S = 0.6  # lost to the jerk when braking


@dataclass(frozen=True, slots=True)
class Leg:
    """Of the way: the places (NED, m) before and behind its goal, or no numbers; the speed across
    the ground; how near is there, or no number; whether it is a takeoff, the height above home."""

    cruise_mps: float
    before_ned_m: Triple = NAN3
    behind_ned_m: Triple = NAN3
    accepted_m: float = math.nan
    takeoff: bool = False
    height_m: float = math.inf


class Trajectory:
    """One vehicle's. `under_way`: it is being followed, from goal to goal."""

    def __init__(
        self, limits: Callable[[ReadParameter], PathLimits], parameters: ParameterTable
    ) -> None:
        self._read, self._parameters = limits, parameters
        self.under_way = False
        self._record = np.zeros(1, RECORD)
        self._address = address(self._record)
        self._record["period_s"] = LOOP_S
        self._resets = 0
        self._goal: MotionSetpoint | None = None
        self._rest: MotionSetpoint | None = None
        self._tune()

    def _tune(self) -> None:
        """As the parameters are now."""
        self._tuned = self._parameters.changes
        self.limits = limits = self._read(self._parameters.__getitem__)
        record = self._record
        record["jerk_mps3"] = limits.jerk_mps3
        record["across_mps2"] = limits.across_mps2
        record["corner_share"] = limits.corner_share
        record["accepted_height_m"] = limits.accepted_height_m
        record["behind_max_m"] = limits.behind_max_m

    @property
    def wants_up(self) -> bool:
        """The goal is above."""
        return bool(self._record["wanted"][0, 2] < -_WANTS_UP_MPS)

    def stop_ned_m(self, nav: Nav) -> Triple:
        """Where a vehicle that flies so can hold, as PX4 foresees its braking."""
        (x, y, z), (vx, vy, _) = nav.position_ned_m, nav.velocity_ned_mps
        brakes_s = _DECIDES_S + 0.5 * math.hypot(vx, vy) / self.limits.across_mps2
        return (x + brakes_s * vx, y + brakes_s * vy, z)

    def leave(self) -> None:
        """Something else is flown; the next way begins with the vehicle's own motion."""
        self.under_way = False

    def _start(self, nav: Nav, velocity_ned_mps: Triple) -> None:
        record = self._record
        record["position"], record["velocity"] = nav.position_ned_m, velocity_ned_mps
        record["acceleration"] = record["phases_s"] = record["turn_mps"] = 0.0
        self._goal = self._rest = None
        self._resets = nav.reset_counter

    def resting(self, goal: MotionSetpoint) -> MotionSetpoint | None:
        """What is flown at this goal, the same object each time; None on the way to it."""
        return self._rest if self.under_way and goal is self._goal else None

    def follow(self, goal: MotionSetpoint, leg: Leg, nav: Nav, *, waits: bool) -> MotionSetpoint:
        """The motion of one period. The goal is a place, or one to sink at with a speed. `waits`:
        it stands on the ground and may not lift off yet."""
        if self._tuned != self._parameters.changes:
            self._tune()
        if waits:
            self._start(nav, (0.0, 0.0, _STARTS_DOWN_MPS))
        elif not self.under_way:
            self._start(nav, nav.velocity_ned_mps)
        self.under_way = True
        if nav.reset_counter != self._resets:
            self._resets, self._rest = nav.reset_counter, None
            self._record["position"] = nav.position_ned_m
        if self._rest is not None and goal is self._goal:
            return self._rest
        self._aim(goal, leg, nav)
        follow.call(self._address)
        record = self._record
        position, velocity, acceleration = (
            tuple(record[name][0].tolist()) for name in ("position", "velocity", "acceleration")
        )
        yaw_rad = goal.yaw_rad
        if math.isnan(yaw_rad) and goal.faces_way:
            yaw_rad = self._heading(goal, nav)
        motion = MotionSetpoint(
            position, velocity, acceleration, yaw_rad, turn_radps=goal.turn_radps
        )
        self._rest = self._arrived(goal, motion)
        return motion if self._rest is None else self._rest

    def _aim(self, goal: MotionSetpoint, leg: Leg, nav: Nav) -> None:
        record, limits = self._record, self.limits
        if goal is not self._goal:
            self._goal, self._rest = goal, None
        place, sink_mps = goal.position_ned_m, goal.velocity_ned_mps[2]
        record["goal"], record["sink_mps"] = place, sink_mps
        record["before"] = place if math.isnan(leg.before_ned_m[0]) else leg.before_ned_m
        record["behind"] = place if math.isnan(leg.behind_ned_m[0]) else leg.behind_ned_m
        record["estimate"] = nav.position_ned_m
        record["cruise_mps"] = min(leg.cruise_mps, limits.speed_across_mps)
        own = math.isnan(leg.accepted_m)
        record["accepted_m"] = limits.accepted_m if own else leg.accepted_m
        rises = record["wanted"][0, 2] < 0.0
        lifts = rises and leg.takeoff and leg.height_m < limits.lift_below_m
        speed_mps, rate_mps2 = limits.speed_down_mps, limits.down_mps2
        if rises:
            speed_mps, rate_mps2 = limits.speed_up_mps, limits.up_mps2
        if lifts:
            speed_mps, rate_mps2 = limits.lift_mps, min(rate_mps2, limits.lift_mps2)
        record["lifts"], record["speed_z_mps"], record["speed_z_mps2"] = lifts, speed_mps, rate_mps2

    def _heading(self, goal: MotionSetpoint, nav: Nav) -> float:
        """To the goal; near it no number, which keeps the course."""
        north = goal.position_ned_m[0] - nav.position_ned_m[0]
        east = goal.position_ned_m[1] - nav.position_ned_m[1]
        far = math.hypot(north, east) > float(self._record["accepted_m"][0])
        return math.atan2(east, north) if far else math.nan

    def _arrived(self, goal: MotionSetpoint, motion: MotionSetpoint) -> MotionSetpoint | None:
        """The motion at the goal, once there; never while it sinks."""
        gap_m = math.dist(goal.position_ned_m, motion.position_ned_m)
        if not (gap_m < _RESTS_M and math.hypot(*motion.velocity_ned_mps) < _RESTS_MPS):
            return None
        record, still = self._record, (0.0, 0.0, 0.0)
        record["position"], record["velocity"] = goal.position_ned_m, still
        record["acceleration"] = record["phases_s"] = 0.0
        return MotionSetpoint(
            goal.position_ned_m, still, still, goal.yaw_rad, turn_radps=goal.turn_radps
        )
