"""The autopilot's own position loop: a motion setpoint and the estimate -> attitude and thrust.

Holds what is kept from one period to the next: integrators, filtered acceleration and yaw. The
equations are in `simulator.autopilot.position_law`. Knows no modes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from simulator.autopilot.position_law import (
    GRAVITY_MPS2,
    attitude_of,
    collective_thrust,
    horizontal,
    or_zero,
    thrust_direction,
    velocity_wanted,
    wrapped,
)
from simulator.firmware.base import PositionGains
from simulator.firmware.values import NAN3, MotionSetpoint, Quaternion, Triple
from simulator.steps import LOOP_S

# The vertical integral may hold up any vehicle; m/s^2 of north, east and down
_INTEGRAL_MAX_MPS2 = (4.0, 4.0, GRAVITY_MPS2)


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits within which a motion is flown; the speeds lower those of the gains."""

    hover_thrust: float  # normalised, as the autopilot believes it
    thrust_least: float = 0.0
    across_mps: float = math.inf
    up_mps: float = math.inf  # below 0 it is a descent
    down_mps: float = math.nan  # replaces the limit of the gains; NaN: theirs
    turn_radps: float = math.inf
    gently: bool = False  # accelerate and brake as in automatic flight


class PositionLoop:
    """Position loop with its integrators, one period of LOOP_S per `step`."""

    def __init__(self, gains: PositionGains) -> None:
        self.tune(gains)
        self.reset(0.0)

    def tune(self, gains: PositionGains) -> None:
        """Use these gains from now on."""
        self.gains = gains
        self._position_p = (gains.position_xy_ps, gains.position_xy_ps, gains.position_z_ps)
        self._velocity_pid = (gains.velocity_xy, gains.velocity_xy, gains.velocity_z)
        share = LOOP_S * 2.0 * math.pi * gains.derivative_cutoff_hz
        self._filter_share = share / (1.0 + share)

    def reset(self, yaw_rad: float) -> None:
        """Clear the integrators and the filter; hold this yaw."""
        self.yaw_rad = yaw_rad
        self._integral_mps2 = [0.0, 0.0, 0.0]
        self._acceleration_mps2 = [0.0, 0.0, 0.0]  # of the estimate, filtered
        self._velocity_mps = NAN3  # of the estimate in the last period
        self._across_mps = math.nan  # wanted in the last period by `gently`

    def step(
        self,
        motion: MotionSetpoint,
        limits: Limits,
        position_ned_m: Triple,
        velocity_ned_mps: Triple,
        *,
        integrate: bool = True,
    ) -> tuple[Quaternion, float, Triple]:
        """Fly one period of LOOP_S.

        Args:
            motion: setpoint, NaN where nothing is demanded.
            limits: of speed, thrust and turn rate in this period.
            position_ned_m, velocity_ned_mps: the estimate.
            integrate: False freezes the integrators.

        Returns:
            Attitude (wxyz, FRD -> NED), normalised thrust, and the velocity (NED, m/s) that the
            loop tries to fly.
        """
        self._filter_acceleration(velocity_ned_mps)
        asked = self._velocity_asked(motion, position_ned_m)
        wanted = self._limit_speed(asked, motion, limits, velocity_ned_mps)
        acceleration = self._acceleration_wanted(motion, wanted, velocity_ned_mps)
        self._turn(motion, limits, asked)
        direction = thrust_direction(acceleration, self.gains.tilt_max_rad)
        thrust = collective_thrust(acceleration[2], direction[2], limits.hover_thrust)
        thrust = min(self.gains.thrust_max, max(limits.thrust_least, thrust))
        if integrate:
            self._integrate(wanted, velocity_ned_mps, thrust, limits.thrust_least)
        return attitude_of(direction, self.yaw_rad), thrust, wanted

    def _filter_acceleration(self, velocity: Triple) -> None:
        """Derivative of the estimated velocity through a first-order low-pass."""
        before, self._velocity_mps = self._velocity_mps, velocity
        if math.isnan(before[0]):
            return
        filtered, share = self._acceleration_mps2, self._filter_share
        for i in range(3):
            slope = (velocity[i] - before[i]) / LOOP_S
            filtered[i] += share * (slope - filtered[i])

    def _velocity_asked(self, motion: MotionSetpoint, position: Triple) -> Triple:
        """Velocity that the setpoint asks for, before any limit."""
        goal, speed, gain = motion.position_ned_m, motion.velocity_ned_mps, self._position_p
        return (
            velocity_wanted(goal[0] - position[0], speed[0], gain[0]),
            velocity_wanted(goal[1] - position[1], speed[1], gain[1]),
            velocity_wanted(goal[2] - position[2], speed[2], gain[2]),
        )

    def _limit_speed(
        self, asked: Triple, motion: MotionSetpoint, limits: Limits, velocity: Triple
    ) -> Triple:
        gains = self.gains
        north, east, down = asked
        speed = horizontal(or_zero(north), or_zero(east))
        most = min(limits.across_mps, gains.speed_xy_mps)
        if limits.gently:
            most = min(most, self._gentle_mps(speed, motion, velocity))
            self._across_mps = min(speed, most)
        if speed > most:
            north, east = north * (most / speed), east * (most / speed)
        if not math.isnan(down):
            up_mps = min(limits.up_mps, gains.speed_up_mps)
            own = math.isnan(limits.down_mps)
            down_mps = gains.speed_down_mps if own else limits.down_mps
            down = max(-up_mps, min(down_mps, down))
        return north, east, down

    def _gentle_mps(self, speed_mps: float, motion: MotionSetpoint, velocity: Triple) -> float:
        """Greatest speed across the ground in this period: little more than in the last one and,
        on the way to a place, no more than it can brake from: v^2 = 2 a d, d = speed / gain."""
        before_mps = self._across_mps
        if math.isnan(before_mps):
            before_mps = horizontal(velocity[0], velocity[1])
        most = before_mps + self.gains.speeding_mps2 * LOOP_S
        gain_ps = self.gains.position_xy_ps
        if math.isnan(motion.velocity_ned_mps[0]) and gain_ps > 0.0:
            squared = 2.0 * self.gains.braking_mps2 * speed_mps / gain_ps
            most = min(most, math.sqrt(squared)) if squared >= 0.0 else most
        return most

    def _acceleration_wanted(
        self, motion: MotionSetpoint, wanted: Triple, velocity: Triple
    ) -> Triple:
        """PID on the velocity error plus the demanded acceleration; the D acts on the estimate."""
        total = [0.0, 0.0, 0.0]
        for i in range(3):
            total[i] = or_zero(motion.acceleration_ned_mps2[i])
            if not math.isnan(wanted[i]):
                p, _, d = self._velocity_pid[i]
                error = wanted[i] - velocity[i]
                total[i] += p * error + self._integral_mps2[i] - d * self._acceleration_mps2[i]
        return total[0], total[1], total[2]

    def _integrate(
        self, wanted: Triple, velocity: Triple, thrust: float, thrust_least: float
    ) -> None:
        """Integrate the velocity errors; the vertical one not into a saturated thrust."""
        for i in range(3):
            error = wanted[i] - velocity[i]
            saturated = i == 2 and (
                (thrust <= thrust_least and error > 0.0)
                or (thrust >= self.gains.thrust_max and error < 0.0)
            )
            if math.isnan(error) or saturated:
                continue
            most = _INTEGRAL_MAX_MPS2[i]
            moved = self._integral_mps2[i] + self._velocity_pid[i][1] * error * LOOP_S
            self._integral_mps2[i] = min(most, max(-most, moved))

    # -- yaw ---------------------------------------------------------------------------------

    def _turn(self, motion: MotionSetpoint, limits: Limits, asked: Triple) -> None:
        """Towards the yaw demanded by the shorter way, else by the yaw rate demanded."""
        goal_rad = self._yaw_asked(motion, asked)
        if math.isfinite(goal_rad):
            most_rad = limits.turn_radps * LOOP_S
            left_rad = wrapped(goal_rad - self.yaw_rad)
            if abs(left_rad) > most_rad:
                goal_rad = wrapped(self.yaw_rad + math.copysign(most_rad, left_rad))
            self.yaw_rad = goal_rad
        elif math.isfinite(motion.yaw_rate_radps):
            self.yaw_rad = wrapped(self.yaw_rad + motion.yaw_rate_radps * LOOP_S)

    def _yaw_asked(self, motion: MotionSetpoint, asked: Triple) -> float:
        """The yaw demanded, or along the velocity asked for; not finite: keep the present one."""
        if math.isfinite(motion.yaw_rad) or not motion.faces_way:
            return motion.yaw_rad
        if not horizontal(asked[0], asked[1]) > self.gains.facing_mps:
            return math.nan
        return math.atan2(asked[1], asked[0])
