"""The autopilot's own position loop: a motion demanded -> attitude and thrust.

P on position, PID on velocity, as multicopter autopilots fly it, on the *estimate* with its raw
velocity: with a wandering estimate it wanders, as the real ones do. Knows no modes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from offboard.model.frames import wrap_pi
from simulator.firmware.base import NAN3, MotionSetpoint, PositionGains, Quaternion, Triple

GRAVITY_MPS2 = 9.80665
_TILT_LIMIT_OF_THRUST = 0.1  # least cosine by which thrust is divided
_INTEGRAL_MAX_MPS2 = 4.0
_THRUST_MIN, _THRUST_MAX = 0.06, 1.0


def _clamp(value: float, low: float, high: float) -> float:
    return min(high, max(low, value))


def _or_zero(value: float) -> float:
    return 0.0 if math.isnan(value) else value


@dataclass(slots=True)
class PositionLoop:
    """Loop with its integrators."""

    gains: PositionGains
    integral_mps2: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    yaw_rad: float = 0.0
    _velocity: Triple = NAN3
    _derivative: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])

    def reset(self, yaw_rad: float) -> None:
        """Forget integrators and derivative; hold the present course."""
        self.integral_mps2 = [0.0, 0.0, 0.0]
        self._derivative = [0.0, 0.0, 0.0]
        self._velocity = NAN3
        self.yaw_rad = yaw_rad

    def step(
        self,
        duration_s: float,
        position_ned_m: Triple,
        velocity_ned_mps: Triple,
        demand: MotionSetpoint,
        hover_thrust: float,
        *,
        speed_xy_mps: float = math.inf,
        speed_up_mps: float = math.inf,
        integrate: bool = True,
    ) -> tuple[Quaternion, float, Triple]:
        """Attitude (wxyz), normalised thrust and the velocity (NED, m/s) that it tries to fly.

        The speeds lower the limits of the gains. `integrate` False freezes the integrators.
        """
        self._differentiate(duration_s, velocity_ned_mps)
        speed_xy_mps = min(speed_xy_mps, self.gains.speed_xy_mps)
        speed_up_mps = min(speed_up_mps, self.gains.speed_up_mps)
        wanted = self._wanted_velocity(position_ned_m, demand, speed_xy_mps, speed_up_mps)
        acceleration = self._acceleration(duration_s, velocity_ned_mps, wanted, demand, integrate)
        self._turn(duration_s, demand)
        attitude, thrust = self._compose(acceleration, hover_thrust)
        return attitude, thrust, wanted

    def _differentiate(self, duration_s: float, velocity: Triple) -> None:
        if not math.isnan(self._velocity[0]):
            share = duration_s * 2.0 * math.pi * self.gains.derivative_cutoff_hz
            share = share / (1.0 + share)
            for i in range(3):
                slope = (velocity[i] - self._velocity[i]) / duration_s
                self._derivative[i] += share * (slope - self._derivative[i])
        self._velocity = velocity

    def _wanted_velocity(
        self, position: Triple, demand: MotionSetpoint, speed_xy_mps: float, speed_up_mps: float
    ) -> Triple:
        """P on the position error plus the velocity demanded; NaN where neither is given."""
        gains = self.gains
        wanted = [math.nan, math.nan, math.nan]
        for i in range(3):
            p = gains.position_z_ps if i == 2 else gains.position_xy_ps
            error = demand.position_ned_m[i] - position[i]
            forward = demand.velocity_ned_mps[i]
            if not math.isnan(error):
                wanted[i] = p * error + _or_zero(forward)
            else:
                wanted[i] = forward
        speed = math.hypot(_or_zero(wanted[0]), _or_zero(wanted[1]))
        if speed > speed_xy_mps:
            wanted[0] *= speed_xy_mps / speed
            wanted[1] *= speed_xy_mps / speed
        if not math.isnan(wanted[2]):
            wanted[2] = _clamp(wanted[2], -speed_up_mps, gains.speed_down_mps)
        return (wanted[0], wanted[1], wanted[2])

    def _acceleration(
        self,
        duration_s: float,
        velocity: Triple,
        wanted: Triple,
        demand: MotionSetpoint,
        integrate: bool,
    ) -> Triple:
        out = [0.0, 0.0, 0.0]
        for i in range(3):
            p, integral_gain, d = self.gains.velocity_z if i == 2 else self.gains.velocity_xy
            out[i] = _or_zero(demand.acceleration_ned_mps2[i])
            if math.isnan(wanted[i]):
                continue
            error = wanted[i] - velocity[i]
            out[i] += p * error + self.integral_mps2[i] - d * self._derivative[i]
            if integrate:
                self.integral_mps2[i] = _clamp(
                    self.integral_mps2[i] + integral_gain * error * duration_s,
                    -_INTEGRAL_MAX_MPS2,
                    _INTEGRAL_MAX_MPS2,
                )
        return (out[0], out[1], out[2])

    def _turn(self, duration_s: float, demand: MotionSetpoint) -> None:
        if not math.isnan(demand.yaw_rad):
            self.yaw_rad = demand.yaw_rad
        elif not math.isnan(demand.yaw_rate_radps):
            self.yaw_rad = wrap_pi(self.yaw_rad + demand.yaw_rate_radps * duration_s)

    def _compose(self, acceleration: Triple, hover_thrust: float) -> tuple[Quaternion, float]:
        """Thrust along the body axis that gives the acceleration; the vertical comes first."""
        lateral = math.hypot(acceleration[0], acceleration[1])
        lateral_max = GRAVITY_MPS2 * math.tan(self.gains.tilt_max_rad)
        scale = lateral_max / lateral if lateral > lateral_max else 1.0
        down = (-acceleration[0] * scale, -acceleration[1] * scale, GRAVITY_MPS2)
        length = math.sqrt(down[0] ** 2 + down[1] ** 2 + down[2] ** 2)
        direction = (down[0] / length, down[1] / length, down[2] / length)
        vertical = hover_thrust * (1.0 - acceleration[2] / GRAVITY_MPS2)
        thrust = _clamp(
            vertical / max(direction[2], _TILT_LIMIT_OF_THRUST), _THRUST_MIN, _THRUST_MAX
        )
        return _facing(direction, self.yaw_rad), thrust


def _facing(direction: Triple, yaw_rad: float) -> Quaternion:
    """Attitude with the third body axis along `direction` (unit, NED) and Euler yaw `yaw_rad`."""
    cos_yaw, sin_yaw = math.cos(yaw_rad), math.sin(yaw_rad)
    ahead = cos_yaw * direction[0] + sin_yaw * direction[1]
    aside = cos_yaw * direction[1] - sin_yaw * direction[0]
    half_roll = 0.5 * math.asin(_clamp(-aside, -1.0, 1.0))
    half_pitch = 0.5 * math.atan2(ahead, direction[2])
    sr, cr = math.sin(half_roll), math.cos(half_roll)
    sp, cp = math.sin(half_pitch), math.cos(half_pitch)
    sy, cy = math.sin(0.5 * yaw_rad), math.cos(0.5 * yaw_rad)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
