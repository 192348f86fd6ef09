"""Equations of the position loop: P on position, PID on velocity, attitude and thrust.

As multicopter autopilots fly it, on the *estimate* with its raw velocity: with a wandering estimate
it wanders, as the real ones do. Pure functions of plain floats, SI and NED; NaN stands for what is
not demanded. The state between two periods is in `simulator.autopilot.position_loop`.
"""

from __future__ import annotations

import math

from simulator.firmware.values import Quaternion, Triple

GRAVITY_MPS2 = 9.80665
_LEAST_DIRECTION_Z = 0.1  # thrust is divided by the cosine of the tilt, and by no less than this


def or_zero(value: float) -> float:
    """The value, or 0 for NaN."""
    return 0.0 if math.isnan(value) else value


def horizontal(north: float, east: float) -> float:
    """Length of a horizontal vector."""
    return abs(complex(north, east))


def velocity_wanted(error_m: float, velocity_mps: float, gain_ps: float) -> float:
    """P on the position error plus the demanded velocity, one axis; NaN where neither is given."""
    if math.isnan(error_m):
        return velocity_mps
    return gain_ps * error_m + or_zero(velocity_mps)


def wrapped(angle_rad: float) -> float:
    """The same angle in [-pi, pi], without rounding; NaN for what is not finite."""
    if angle_rad - angle_rad != 0.0:
        return math.nan
    turn = 2.0 * math.pi
    rest = math.fmod(angle_rad, turn)
    if abs(rest) > math.pi:
        rest -= math.copysign(turn, rest)
    return rest


def thrust_direction(acceleration_ned_mps2: Triple, tilt_max_rad: float) -> Triple:
    """Third body axis (unit, NED) for this acceleration across the ground, within the tilt limit;
    the vertical acceleration is left to the thrust."""
    north, east, _ = acceleration_ned_mps2
    lateral = horizontal(north, east)
    lateral_max = GRAVITY_MPS2 * math.tan(tilt_max_rad)
    scale = lateral_max / lateral if lateral > lateral_max else 1.0
    north, east = -north * scale, -east * scale
    length = math.sqrt(north * north + east * east + GRAVITY_MPS2 * GRAVITY_MPS2)
    return north / length, east / length, GRAVITY_MPS2 / length


def collective_thrust(acceleration_down_mps2: float, direction_z: float, hover: float) -> float:
    """Normalised thrust for this vertical acceleration; `direction_z`: cosine of the tilt."""
    vertical = hover * (1.0 - acceleration_down_mps2 / GRAVITY_MPS2)
    return vertical / max(direction_z, _LEAST_DIRECTION_Z)


def attitude_of(direction: Triple, yaw_rad: float) -> Quaternion:
    """Attitude (wxyz, FRD -> NED) with the third body axis along `direction` and this Euler yaw."""
    cos_yaw, sin_yaw = math.cos(yaw_rad), math.sin(yaw_rad)
    forward = cos_yaw * direction[0] + sin_yaw * direction[1]
    right = cos_yaw * direction[1] - sin_yaw * direction[0]
    half_roll = 0.5 * math.asin(min(1.0, max(-1.0, -right)))
    half_pitch = 0.5 * math.atan2(forward, direction[2])
    sr, cr = math.sin(half_roll), math.cos(half_roll)
    sp, cp = math.sin(half_pitch), math.cos(half_pitch)
    sy, cy = math.sin(0.5 * yaw_rad), math.cos(0.5 * yaw_rad)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
