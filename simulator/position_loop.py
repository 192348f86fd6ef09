"""The autopilot's own position loop: a motion demanded -> attitude and thrust.

P on position, PID on velocity, as multicopter autopilots fly it, on the *estimate* with its raw
velocity: with a wandering estimate it wanders, as the real ones do. Knows no modes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numba
import numpy as np
from numpy.typing import NDArray

from offboard.model.frames import wrap_pi
from simulator.firmware.base import NAN3, MotionSetpoint, PositionGains, Quaternion, Triple

Array = NDArray[np.float64]

GRAVITY_MPS2 = 9.80665
_TILT_LIMIT_OF_THRUST = 0.1  # least cosine by which thrust is divided
_INTEGRAL_MAX_MPS2 = 4.0
_THRUST_MIN, _THRUST_MAX = 0.06, 1.0

# State: integrals m/s^2, filtered derivative of the velocity, velocity of the last period.
_DERIVATIVE, _VELOCITY = 3, 6
_AT_REST = (0.0,) * 6 + NAN3
# Gains: position P, velocity P, I and D of north, east and down, and then these.
_SPEED_DOWN, _CUTOFF = 12, 13


@numba.njit(cache=True)
def _or_zero(value: float) -> float:
    return 0.0 if math.isnan(value) else value


@dataclass(slots=True)
class PositionLoop:
    """Loop with its integrators."""

    gains: PositionGains
    yaw_rad: float = 0.0
    _state: Array = field(default_factory=lambda: np.array(_AT_REST))
    _packed: Array = field(init=False)

    def __post_init__(self) -> None:
        gains = self.gains
        across = (gains.position_xy_ps, *gains.velocity_xy)
        up = (gains.position_z_ps, *gains.velocity_z)
        limits = (gains.speed_down_mps, gains.derivative_cutoff_hz)
        self._packed = np.array([*across, *across, *up, *limits])
        # compiles, which would be a stall of a second in flight
        self.step(1.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), MotionSetpoint(), 0.5)
        self.reset(self.yaw_rad)

    def reset(self, yaw_rad: float) -> None:
        """Forget integrators and derivative; hold the present course."""
        self._state[:] = _AT_REST
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
        gains = self.gains
        acceleration, wanted = _demand(
            self._state,
            self._packed,
            position_ned_m,
            velocity_ned_mps,
            demand.position_ned_m,
            demand.velocity_ned_mps,
            demand.acceleration_ned_mps2,
            (
                duration_s,
                min(speed_xy_mps, gains.speed_xy_mps),
                min(speed_up_mps, gains.speed_up_mps),
            ),
            integrate,
        )
        self._turn(duration_s, demand)
        attitude, thrust = _compose(acceleration, gains.tilt_max_rad, hover_thrust, self.yaw_rad)
        return attitude, thrust, wanted

    def _turn(self, duration_s: float, demand: MotionSetpoint) -> None:
        if not math.isnan(demand.yaw_rad):
            self.yaw_rad = demand.yaw_rad
        elif not math.isnan(demand.yaw_rate_radps):
            self.yaw_rad = wrap_pi(self.yaw_rad + demand.yaw_rate_radps * duration_s)


@numba.njit(cache=True)
def _facing(direction: Triple, yaw_rad: float) -> Quaternion:
    """Attitude with the third body axis along `direction` (unit, NED) and Euler yaw `yaw_rad`."""
    cos_yaw, sin_yaw = math.cos(yaw_rad), math.sin(yaw_rad)
    ahead = cos_yaw * direction[0] + sin_yaw * direction[1]
    aside = cos_yaw * direction[1] - sin_yaw * direction[0]
    half_roll = 0.5 * math.asin(min(1.0, max(-1.0, -aside)))
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


@numba.njit(cache=True)
def _demand(
    state: Array,
    gains: Array,
    position: Triple,
    velocity: Triple,
    wanted_position: Triple,
    wanted_velocity: Triple,
    wanted_acceleration: Triple,
    options: Triple,
    integrate: bool,
) -> tuple[Triple, Triple]:
    """Acceleration to fly (NED) and the velocity wanted; `state` is moved on by one period.

    `options`: duration s, speed limit across and upwards m/s.
    """
    duration_s, speed_xy_mps, speed_up_mps = options
    if not math.isnan(state[_VELOCITY]):
        share = duration_s * 2.0 * math.pi * gains[_CUTOFF]
        share = share / (1.0 + share)
        for i in range(3):
            slope = (velocity[i] - state[_VELOCITY + i]) / duration_s
            state[_DERIVATIVE + i] += share * (slope - state[_DERIVATIVE + i])
    wanted, out = np.empty(3), np.empty(3)
    for i in range(3):
        state[_VELOCITY + i] = velocity[i]
        # P on the position error plus the velocity demanded; NaN where neither is given
        error = wanted_position[i] - position[i]
        wanted[i] = wanted_velocity[i]
        if not math.isnan(error):
            wanted[i] = gains[4 * i] * error + _or_zero(wanted[i])
    speed = math.hypot(_or_zero(wanted[0]), _or_zero(wanted[1]))
    if speed > speed_xy_mps:
        wanted[0] *= speed_xy_mps / speed
        wanted[1] *= speed_xy_mps / speed
    if not math.isnan(wanted[2]):
        wanted[2] = min(gains[_SPEED_DOWN], max(-speed_up_mps, wanted[2]))
    for i in range(3):
        out[i] = _or_zero(wanted_acceleration[i])
        if math.isnan(wanted[i]):
            continue
        p, integral_gain, d = gains[4 * i + 1], gains[4 * i + 2], gains[4 * i + 3]
        error = wanted[i] - velocity[i]
        out[i] += p * error + state[i] - d * state[_DERIVATIVE + i]
        if integrate:
            moved = state[i] + integral_gain * error * duration_s
            state[i] = min(_INTEGRAL_MAX_MPS2, max(-_INTEGRAL_MAX_MPS2, moved))
    return (out[0], out[1], out[2]), (wanted[0], wanted[1], wanted[2])


@numba.njit(cache=True)
def _compose(
    acceleration: Triple, tilt_max_rad: float, hover_thrust: float, yaw_rad: float
) -> tuple[Quaternion, float]:
    """Thrust along the body axis that gives the acceleration; the vertical comes first."""
    lateral = math.hypot(acceleration[0], acceleration[1])
    lateral_max = GRAVITY_MPS2 * math.tan(tilt_max_rad)
    scale = lateral_max / lateral if lateral > lateral_max else 1.0
    north, east = -acceleration[0] * scale, -acceleration[1] * scale
    length = math.sqrt(north**2 + east**2 + GRAVITY_MPS2**2)
    direction = (north / length, east / length, GRAVITY_MPS2 / length)
    vertical = hover_thrust * (1.0 - acceleration[2] / GRAVITY_MPS2)
    thrust = vertical / max(direction[2], _TILT_LIMIT_OF_THRUST)
    return _facing(direction, yaw_rad), min(_THRUST_MAX, max(_THRUST_MIN, thrust))
