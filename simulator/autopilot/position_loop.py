"""The autopilot's position loop: a motion setpoint and the estimate -> attitude and thrust.

P on position, PID on velocity, as in multicopter autopilots. It controls the *estimated* position
and velocity, so the vehicle drifts as the estimate does. NED, SI; NaN where nothing is demanded.
Knows no modes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from offboard.model.frames import quaternion_from_euler, wrap_pi
from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.state import StateEstimate
from simulator.autopilot.values import NAN3, MotionSetpoint, Quaternion, Triple
from simulator.geodesy import GRAVITY_MPS2
from simulator.steps import LOOP_S

# Gains of the axes north, east and down
_POSITION_P = ("position_xy_p", "position_xy_p", "position_z_p")
_VELOCITY_P = ("velocity_xy_p", "velocity_xy_p", "velocity_z_p")
_VELOCITY_I = ("velocity_xy_i", "velocity_xy_i", "velocity_z_i")
_VELOCITY_D = ("velocity_xy_d", "velocity_xy_d", "velocity_z_d")
_INTEGRAL_XY_MAX_MPS2 = 4.0
_REACHED_RAD = 0.05  # a smaller yaw error is turned the shorter way, whatever the sense demanded
_TILT_COSINE_MIN = 0.1  # least divisor of the thrust
# Estimated hover thrust: height from which it is estimated; time constant, a mean of PX4's, which
# grows; greatest distance from the parameter (HTE_THR_RANGE); least value
_HOVER_IN_AIR_M, _HOVER_TIME_S, _HOVER_RANGE, _HOVER_LEAST = 1.0, 2.0, 0.2, 0.05
# First-order low-pass of 5 Hz for the derivative of the velocity: weight of the newest value
_TIMES_CUTOFF = LOOP_S * 2.0 * math.pi * 5.0
_FILTER_SHARE = _TIMES_CUTOFF / (1.0 + _TIMES_CUTOFF)


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a motion. A speed limit applies in addition to that of the parameters."""

    thrust_least: float = 0.0
    across_mps: float = math.inf  # horizontal speed
    up_mps: float = math.inf  # below 0 it forces a descent
    turn_radps: float = math.inf
    smooth: bool = False  # whether acceleration and braking are limited as in automatic flight


class PositionLoop:
    """Position loop with its integrators, one period of LOOP_S per `step`."""

    def __init__(self, parameters: ParameterTable) -> None:
        self._role = parameters.role
        self.forget_hover_thrust()
        self.reset(0.0)

    def reset(self, yaw_rad: float, *, integral: bool = True) -> None:
        """Clear the filter and, if `integral`, the integrators; hold this yaw."""
        self.yaw_rad = yaw_rad
        if integral:
            self._integral_mps2 = [0.0, 0.0, 0.0]
        self._acceleration_mps2 = [0.0, 0.0, 0.0]  # derivative of the estimated velocity, filtered
        self._velocity_mps = NAN3  # estimated velocity in the last period
        # last setpoint (north, east; down) under `Limits.smooth`
        self._across_ned_mps, self._down_mps = (math.nan, math.nan), math.nan
        self._down_mps2 = 0.0  # last vertical acceleration that was demanded

    def forget_hover_thrust(self) -> None:
        """Use the hover thrust of the parameter; estimate it again after the next takeoff."""
        self._hover_thrust, self._hover_down_mps = 0.0, math.nan  # 0: not estimated

    def estimate_hover_thrust(self, thrust: float, estimate: StateEstimate) -> None:
        """Estimate the hover thrust in the air where the firmware does so (MPC_USE_HTE), from the
        vertical thrust and the acceleration of this period. The integral takes up a change, so that
        the demanded thrust stays the same."""
        before_mps, self._hover_down_mps = self._hover_down_mps, estimate.velocity_ned_mps[2]
        in_air = self._hover_thrust > 0.0 or estimate.ground_m > _HOVER_IN_AIR_M
        if math.isnan(before_mps) or not (in_air and self._role("hover_estimated")):
            return
        given = self._role("hover_thrust")
        old = self._hover_thrust or given
        specific_force = 1.0 + (before_mps - self._hover_down_mps) / (LOOP_S * GRAVITY_MPS2)
        found = old + LOOP_S / _HOVER_TIME_S * (thrust - old * specific_force)
        new = min(given + _HOVER_RANGE, max(given - _HOVER_RANGE, _HOVER_LEAST, found))
        self._integral_mps2[2] += (GRAVITY_MPS2 - self._down_mps2) * (1.0 - old / new)
        self._hover_thrust = new

    def step(
        self,
        motion: MotionSetpoint,
        limits: Limits,
        estimate: StateEstimate,
        *,
        integrate: bool = True,
    ) -> tuple[Quaternion, float, Triple]:
        """Run one period of LOOP_S.

        Args:
            motion: setpoint, NaN where nothing is demanded.
            limits: limits of speed, thrust and turn rate in this period.
            estimate: estimated state; position and velocity are used.
            integrate: False freezes the integrators.

        Returns:
            Attitude (wxyz, FRD -> NED), normalised thrust, and the setpoint (NED, m/s) of the
            velocity loop.
        """
        velocity = estimate.velocity_ned_mps
        self._filter_acceleration(velocity)
        demanded = self._velocity_demanded(motion, estimate.position_ned_m)
        setpoint = self._limit_speed(demanded, motion, limits, velocity)
        acceleration = self._acceleration(motion, setpoint, velocity)
        self._turn(motion, limits, demanded)
        direction = thrust_direction(acceleration, self._role("tilt_max_rad"))
        self._down_mps2 = acceleration[2]
        hover_thrust = self._hover_thrust or self._role("hover_thrust")
        thrust = hover_thrust * (1.0 - acceleration[2] / GRAVITY_MPS2)
        thrust = thrust / max(direction[2], _TILT_COSINE_MIN)
        thrust = min(self._role("thrust_max"), max(limits.thrust_least, thrust))
        if integrate:
            self._integrate(setpoint, velocity, thrust, limits.thrust_least)
        return attitude(direction, self.yaw_rad), thrust, setpoint

    def _filter_acceleration(self, velocity: Triple) -> None:
        """Differentiate the estimated velocity and filter the result."""
        before, self._velocity_mps = self._velocity_mps, velocity
        if math.isnan(before[0]):
            return
        filtered = self._acceleration_mps2
        for i in range(3):
            slope = (velocity[i] - before[i]) / LOOP_S
            filtered[i] += _FILTER_SHARE * (slope - filtered[i])

    def _velocity_demanded(self, motion: MotionSetpoint, position: Triple) -> Triple:
        """Return P times the position error plus the demanded velocity, before any limit."""
        goal, speed = motion.position_ned_m, motion.velocity_ned_mps
        north, east, down = (
            speed[i]
            if math.isnan(goal[i] - position[i])
            else self._role(_POSITION_P[i]) * (goal[i] - position[i]) + _or_zero(speed[i])
            for i in range(3)
        )
        return north, east, down

    def _limit_speed(
        self, demanded: Triple, motion: MotionSetpoint, limits: Limits, velocity: Triple
    ) -> Triple:
        role = self._role
        north, east, down = demanded
        speed = math.hypot(_or_zero(north), _or_zero(east))
        most = min(limits.across_mps, role("speed_xy_mps"))
        if limits.smooth and not math.isnan(motion.position_ned_m[0]):
            most = min(most, self._smooth_mps(speed, motion, velocity))
        if speed > most:
            north, east = north * (most / speed), east * (most / speed)
        if limits.smooth:
            if math.isnan(motion.position_ned_m[0]):
                north, east = self._smooth_across(north, east, velocity)
            self._across_ned_mps = north, east
        if not math.isnan(down):
            if limits.smooth:
                down = self._smooth_down_mps(down, velocity[2])
            up_mps = min(limits.up_mps, role("speed_up_mps"))
            down = max(-up_mps, min(role("speed_down_mps"), down))
            self._down_mps = down if limits.smooth else math.nan
        return north, east, down

    def _smooth_mps(self, speed_mps: float, motion: MotionSetpoint, velocity: Triple) -> float:
        """Return the greatest horizontal speed: acceleration since the last period is limited and,
        on the way to a place, the vehicle must be able to brake: v^2 = 2 a d, d = speed / gain."""
        before = self._across_ned_mps
        before = velocity[:2] if math.isnan(before[0]) else before
        most = math.hypot(*before) + self._role("speeding_mps2") * LOOP_S
        gain_ps = self._role("position_xy_p")
        if math.isnan(motion.velocity_ned_mps[0]) and gain_ps > 0.0:
            squared = 2.0 * self._role("braking_mps2") * speed_mps / gain_ps
            most = min(most, math.sqrt(squared)) if squared >= 0.0 else most
        return most

    def _smooth_across(self, north: float, east: float, velocity: Triple) -> tuple[float, float]:
        """Return the horizontal velocity, with limited acceleration since the last period."""
        before = self._across_ned_mps
        x, y = velocity[:2] if math.isnan(before[0]) else before
        change_mps = math.hypot(north - x, east - y)
        share = min(1.0, self._role("speeding_mps2") * LOOP_S / max(change_mps, 1e-9))
        return x + share * (north - x), y + share * (east - y)

    def _smooth_down_mps(self, down_mps: float, velocity_mps: float) -> float:
        """Return the vertical speed, with limited acceleration since the last period."""
        before_mps = velocity_mps if math.isnan(self._down_mps) else self._down_mps
        most = self._role("vertical_mps2") * LOOP_S
        return min(before_mps + most, max(before_mps - most, down_mps))

    def _acceleration(self, motion: MotionSetpoint, setpoint: Triple, velocity: Triple) -> Triple:
        """Return PID of the velocity error plus the demanded acceleration; D acts on the estimated
        velocity, not on its setpoint."""
        total = [0.0, 0.0, 0.0]
        for i in range(3):
            total[i] = _or_zero(motion.acceleration_ned_mps2[i])
            if not math.isnan(setpoint[i]):
                p, d = self._role(_VELOCITY_P[i]), self._role(_VELOCITY_D[i])
                error = setpoint[i] - velocity[i]
                total[i] += p * error + self._integral_mps2[i] - d * self._acceleration_mps2[i]
        return total[0], total[1], total[2]

    def _integrate(
        self, setpoint: Triple, velocity: Triple, thrust: float, thrust_least: float
    ) -> None:
        """Integrate the velocity errors, but not the vertical one if that would saturate the thrust
        further."""
        for i in range(3):
            error = setpoint[i] - velocity[i]
            saturated = i == 2 and (
                (thrust <= thrust_least and error > 0.0)
                or (thrust >= self._role("thrust_max") and error < 0.0)
            )
            if math.isnan(error) or saturated:
                continue
            most = self._role("integral_z_max_mps2") if i == 2 else _INTEGRAL_XY_MAX_MPS2
            gain = self._role(_VELOCITY_I[i])
            integral = self._integral_mps2[i] + gain * error * LOOP_S
            self._integral_mps2[i] = min(most, max(-most, integral))

    def _turn(self, motion: MotionSetpoint, limits: Limits, demanded: Triple) -> None:
        """Turn to the demanded yaw in the demanded sense; without a yaw, at the demanded rate."""
        yaw_rad = self._yaw_demanded(motion, demanded)
        if math.isfinite(yaw_rad):
            most_rad = limits.turn_radps * LOOP_S
            error_rad = wrap_pi(yaw_rad - self.yaw_rad)
            if error_rad * motion.turn_sense < 0.0 and abs(error_rad) > _REACHED_RAD:
                error_rad += math.copysign(math.tau, motion.turn_sense)
            if abs(error_rad) > most_rad:
                yaw_rad = wrap_pi(self.yaw_rad + math.copysign(most_rad, error_rad))
            self.yaw_rad = yaw_rad
        elif math.isfinite(motion.yaw_rate_radps):
            self.yaw_rad = wrap_pi(self.yaw_rad + motion.yaw_rate_radps * LOOP_S)

    def _yaw_demanded(self, motion: MotionSetpoint, demanded: Triple) -> float:
        """Return the demanded yaw, or the direction of the demanded velocity with
        `MotionSetpoint.faces_way`; not finite: there is no demand."""
        if math.isfinite(motion.yaw_rad) or not motion.faces_way:
            return motion.yaw_rad
        if not math.hypot(demanded[0], demanded[1]) > self._role("facing_mps"):
            return math.nan
        return math.atan2(demanded[1], demanded[0])


def _or_zero(value: float) -> float:
    return 0.0 if math.isnan(value) else value


def thrust_direction(acceleration_ned_mps2: Triple, tilt_max_rad: float) -> Triple:
    """Return the third body axis (unit vector, NED) for this horizontal acceleration at hover
    thrust, within the tilt limit. The vertical acceleration changes only the thrust."""
    north, east, _ = acceleration_ned_mps2
    lateral = math.hypot(north, east)
    lateral_max = GRAVITY_MPS2 * math.tan(tilt_max_rad)
    scale = lateral_max / lateral if lateral > lateral_max else 1.0
    north, east = -north * scale, -east * scale
    length = math.sqrt(north * north + east * east + GRAVITY_MPS2 * GRAVITY_MPS2)
    return north / length, east / length, GRAVITY_MPS2 / length


def level(yaw_rad: float) -> Quaternion:
    """Attitude (wxyz) with this yaw and no tilt."""
    return (math.cos(0.5 * yaw_rad), 0.0, 0.0, math.sin(0.5 * yaw_rad))


def attitude(direction: Triple, yaw_rad: float) -> Quaternion:
    """Attitude (wxyz, FRD -> NED) with the third body axis along `direction` and this yaw."""
    cos_yaw, sin_yaw = math.cos(yaw_rad), math.sin(yaw_rad)
    forward = cos_yaw * direction[0] + sin_yaw * direction[1]
    right = cos_yaw * direction[1] - sin_yaw * direction[0]
    roll_rad = math.asin(min(1.0, max(-1.0, -right)))
    pitch_rad = math.atan2(forward, direction[2])
    w, x, y, z = quaternion_from_euler(roll_rad, pitch_rad, yaw_rad).tolist()
    return w, x, y, z
