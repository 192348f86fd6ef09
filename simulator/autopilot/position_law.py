"""The law of the position loop, compiled: one period on the estimate, in place.

P on position, PID on velocity, as multicopter autopilots fly it, on the *estimate* with its raw
velocity: with a wandering estimate it wanders, as the real ones do. Knows a record alone
(`simulator.autopilot.position_loop` fills it).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.model.kernel import entry, kernel
from simulator.firmware.vocabulary import Quaternion, Triple
from simulator.steps import LOOP_S

Array = NDArray[np.float64]

GRAVITY_MPS2 = 9.80665
_TILT_LIMIT_OF_THRUST = 0.1  # least cosine by which thrust is divided
_INTEGRAL_ACROSS_MAX_MPS2 = 4.0  # of the vertical it is gravity, so that any vehicle hovers

# State: integrals m/s^2, filtered derivative of the velocity, velocity of the last period.
_DERIVATIVE, _VELOCITY = 3, 6
_CUTOFF = 12  # behind the gains: position P, velocity P, I and D of north, east and down

RECORD = np.dtype(
    [
        ("state", "f8", 9),
        ("gains", "f8", 13),
        ("tilt_max_rad", "f8"),
        # what is demanded, NED; not a number where nothing is
        ("position", "f8", 3),
        ("velocity", "f8", 3),
        ("acceleration", "f8", 3),
        ("yaw_rad", "f8"),
        ("yaw_rate_radps", "f8"),
        ("faces_way", "i8"),
        # and how
        ("period_s", "f8"),
        ("speed_xy_mps", "f8"),
        ("speed_up_mps", "f8"),
        ("speed_down_mps", "f8"),
        ("hover_thrust", "f8"),
        ("thrust_least", "f8"),
        ("thrust_max", "f8"),
        ("turn_radps", "f8"),
        ("facing_mps", "f8"),
        ("gently", "i8"),
        ("speeding_mps2", "f8"),
        ("braking_mps2", "f8"),
        ("integrates", "i8"),
        # the estimate: position and velocity NED
        ("estimate", "f8", 6),
        ("across_mps", "f8"),  # wanted in the last period, or not a number
        ("way", "f8", 2),  # velocity wanted across the ground before it is limited
        # what comes out
        ("course_rad", "f8"),
        ("attitude", "f8", 4),
        ("thrust", "f8"),
        ("wanted_velocity", "f8", 3),
        ("wanted_acceleration", "f8", 3),
    ],
    align=True,
)
"""All that compiled code knows of one position loop; SI and NED."""


@kernel
def _or_zero(value: float) -> float:
    return 0.0 if math.isnan(value) else value


@entry(RECORD)
def step_loop(loop: Any) -> int:
    """One period on the estimate."""
    _accelerate(loop, loop.estimate)
    course_rad = _course_wanted(loop)
    if not math.isnan(course_rad):
        _turn(loop, course_rad)
    elif not math.isnan(loop.yaw_rate_radps):
        loop.course_rad = _wrapped(loop.course_rad + loop.yaw_rate_radps * loop.period_s)
    _compose(loop)
    if loop.integrates:
        _integrate(loop, loop.estimate)
    return 0


@kernel
def _course_wanted(loop: Any) -> float:
    """The course demanded, or the way that it wants to fly; no number keeps the present one."""
    if not math.isnan(loop.yaw_rad) or not loop.faces_way:
        return float(loop.yaw_rad)
    ahead, aside = loop.way
    if not math.hypot(ahead, aside) > loop.facing_mps:
        return math.nan
    return math.atan2(aside, ahead)


@kernel
def _turn(loop: Any, course_rad: float) -> None:
    """Towards this course, the shorter way round."""
    most_rad = loop.turn_radps * loop.period_s
    left_rad = _wrapped(course_rad - loop.course_rad)
    if abs(left_rad) > most_rad:
        course_rad = _wrapped(loop.course_rad + math.copysign(most_rad, left_rad))
    loop.course_rad = course_rad


@kernel
def _wrapped(angle_rad: float) -> float:
    """The same angle in [-pi, pi], without rounding; what is not finite is no number."""
    if angle_rad - angle_rad != 0.0:
        return math.nan
    turn = 2.0 * math.pi
    rest: float = np.fmod(angle_rad, turn)
    if abs(rest) > math.pi:
        rest -= math.copysign(turn, rest)
    return rest


@kernel
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


@kernel
def _accelerate(loop: Any, estimate: Array) -> None:
    """The velocity wanted and the acceleration to fly (NED); the state is moved on."""
    state, gains, wanted, out = (
        loop.state,
        loop.gains,
        loop.wanted_velocity,
        loop.wanted_acceleration,
    )
    if not math.isnan(state[_VELOCITY]):
        share = loop.period_s * 2.0 * math.pi * gains[_CUTOFF]
        share = share / (1.0 + share)
        for i in range(3):
            slope = (estimate[3 + i] - state[_VELOCITY + i]) / loop.period_s
            state[_DERIVATIVE + i] += share * (slope - state[_DERIVATIVE + i])
    for i in range(3):
        state[_VELOCITY + i] = estimate[3 + i]
        # P on the position error plus the velocity demanded; NaN where neither is given
        error = loop.position[i] - estimate[i]
        wanted[i] = loop.velocity[i]
        if not math.isnan(error):
            wanted[i] = gains[4 * i] * error + _or_zero(wanted[i])
    loop.way[0], loop.way[1] = wanted[0], wanted[1]
    _limit_speed(loop)
    for i in range(3):
        out[i] = _or_zero(loop.acceleration[i])
        if math.isnan(wanted[i]):
            continue
        p, d = gains[4 * i + 1], gains[4 * i + 3]
        error = wanted[i] - estimate[3 + i]
        out[i] += p * error + state[i] - d * state[_DERIVATIVE + i]


@kernel
def _integrate(loop: Any, estimate: Array) -> None:
    """Sum the velocity errors; the vertical one not further where the thrust is at that end."""
    for i in range(3):
        error = loop.wanted_velocity[i] - estimate[3 + i]
        ends = i == 2 and (
            (loop.thrust <= loop.thrust_least and error > 0.0)
            or (loop.thrust >= loop.thrust_max and error < 0.0)
        )
        if math.isnan(error) or ends:
            continue
        most = GRAVITY_MPS2 if i == 2 else _INTEGRAL_ACROSS_MAX_MPS2
        moved = loop.state[i] + loop.gains[4 * i + 2] * error * loop.period_s
        loop.state[i] = min(most, max(-most, moved))


@kernel
def _gentle_mps(loop: Any, speed_mps: float) -> float:
    """The speed it may have now: little more than before, and no more than it can brake from
    where it has a place to stop at, `speed_mps` being the position error times its gain."""
    before_mps = loop.across_mps
    if math.isnan(before_mps):
        before_mps = math.hypot(loop.estimate[3], loop.estimate[4])
    most = before_mps + loop.speeding_mps2 * LOOP_S
    if math.isnan(loop.velocity[0]):
        most = min(most, math.sqrt(2.0 * loop.braking_mps2 * speed_mps / loop.gains[0]))
    return float(most)


@kernel
def _limit_speed(loop: Any) -> None:
    wanted = loop.wanted_velocity
    speed = math.hypot(_or_zero(wanted[0]), _or_zero(wanted[1]))
    most = loop.speed_xy_mps
    if loop.gently:
        most = min(most, _gentle_mps(loop, speed))
        loop.across_mps = min(speed, most)
    if speed > most:
        wanted[0] *= most / speed
        wanted[1] *= most / speed
    if not math.isnan(wanted[2]):
        wanted[2] = max(-loop.speed_up_mps, min(loop.speed_down_mps, wanted[2]))


@kernel
def _compose(loop: Any) -> None:
    """Thrust along the body axis that gives the acceleration; the vertical comes first."""
    acceleration = loop.wanted_acceleration
    lateral = math.hypot(acceleration[0], acceleration[1])
    lateral_max = GRAVITY_MPS2 * math.tan(loop.tilt_max_rad)
    scale = lateral_max / lateral if lateral > lateral_max else 1.0
    north, east = -acceleration[0] * scale, -acceleration[1] * scale
    length = math.sqrt(north**2 + east**2 + GRAVITY_MPS2**2)
    direction = (north / length, east / length, GRAVITY_MPS2 / length)
    vertical = loop.hover_thrust * (1.0 - acceleration[2] / GRAVITY_MPS2)
    thrust = vertical / max(direction[2], _TILT_LIMIT_OF_THRUST)
    loop.thrust = min(loop.thrust_max, max(loop.thrust_least, thrust))
    attitude = _facing(direction, loop.course_rad)
    for i in range(4):
        loop.attitude[i] = attitude[i]
