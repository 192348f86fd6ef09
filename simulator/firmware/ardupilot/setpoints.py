"""How ArduCopter reads setpoint messages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from simulator.firmware.base import SetpointRules
from simulator.firmware.values import (
    NAN3,
    AttitudeSetpoint,
    MotionSetpoint,
    Quaternion,
    ReadParameter,
    Triple,
)

_CENTI = 0.01
_RATES_IGNORED, _THRUST_IGNORED, _ATTITUDE_IGNORED = 0b111, 64, 128
_NORM_TOLERANCE = 0.0005
_THRUST_IS_THRUST = 8  # GUID_OPTIONS
_STOP = MotionSetpoint(velocity_ned_mps=(0.0, 0.0, 0.0))
# Rates beside an attitude: 0.3 rad/s move the equilibrium by 3 degrees
_RATE_LEAD_S = 0.175


def attitude_setpoint(
    values: Mapping[str, Any], parameter: ReadParameter
) -> AttitudeSetpoint | MotionSetpoint | None:
    """SET_ATTITUDE_TARGET as ArduCopter reads it; None: ignored without an answer.

    Ignored: a message without thrust, a quaternion that is not of unit length. With some of the
    rates ignored the vehicle holds its position. A thrust that is NaN counts as zero, and latches
    an internal error (the real SITL stops at a NaN quaternion; a flight controller ignores it).
    """
    mask = values["type_mask"]
    ignored = mask & _RATES_IGNORED
    if mask & _THRUST_IGNORED:
        return None
    if ignored not in (0, _RATES_IGNORED):
        return _STOP
    given = (values["body_roll_rate"], values["body_pitch_rate"], values["body_yaw_rate"])
    rates: Triple = (0.0, 0.0, 0.0) if ignored else given
    if not all(map(math.isfinite, rates)):
        return None
    thrust, climb_mps, event = _vertical(values["thrust"], parameter)
    if mask & _ATTITUDE_IGNORED:
        return AttitudeSetpoint(None, rates, thrust, climb_mps, event)
    w, x, y, z = values["q"]
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not abs(norm - 1.0) <= _NORM_TOLERANCE:
        return None
    p, q, r = (0.5 * _RATE_LEAD_S * rate for rate in rates)
    ahead = (
        w - x * p - y * q - z * r,
        x + w * p + y * r - z * q,
        y + w * q + z * p - x * r,
        z + w * r + x * q - y * p,
    )
    return AttitudeSetpoint(ahead, None, thrust, climb_mps, event)


def _vertical(thrust: float, parameter: ReadParameter) -> tuple[float, float | None, str]:
    """Thrust, climb rate (None: the field is a thrust) and the event of a NaN."""
    by_thrust = int(parameter("GUID_OPTIONS")) & _THRUST_IS_THRUST
    event = ""
    if math.isnan(thrust):
        thrust, event = 0.0 if by_thrust else 0.5, "thrust not a number"
    thrust = min(1.0, max(-1.0, thrust))
    if by_thrust:
        return max(0.0, thrust), None, event
    up = parameter("WPNAV_SPEED_UP") if thrust > 0.5 else parameter("WPNAV_SPEED_DN")
    return 0.0, (max(0.0, thrust) - 0.5) / 0.5 * up * _CENTI, event


_LOCAL_NED, _LOCAL_OFFSET_NED, _BODY_NED, _BODY_OFFSET_NED = 1, 7, 8, 9  # MAV_FRAME
_OFFSET = frozenset({_LOCAL_OFFSET_NED, _BODY_NED, _BODY_OFFSET_NED})
_BODY = frozenset({_BODY_NED, _BODY_OFFSET_NED})
_POSITION, _VELOCITY, _ACCELERATION, _FORCE, _YAW, _YAW_RATE = 0o007, 0o070, 0o700, 512, 1024, 2048


def in_local_frame(
    values: Mapping[str, Any], position_ned_m: Triple, attitude: Quaternion
) -> Mapping[str, Any]:
    """Offset frames are relative to the present position; body frames also to the present yaw."""
    frame = values["coordinate_frame"]
    if frame not in _OFFSET:
        return values
    w, x, y, z = attitude
    yaw_rad = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    turn_rad = yaw_rad if frame in _BODY else 0.0
    cos_yaw, sin_yaw = math.cos(turn_rad), math.sin(turn_rad)
    local = {**values, "coordinate_frame": _LOCAL_NED, "yaw": turn_rad + values["yaw"]}
    for north, east in (("x", "y"), ("vx", "vy"), ("afx", "afy")):
        local[north] = cos_yaw * values[north] - sin_yaw * values[east]
        local[east] = sin_yaw * values[north] + cos_yaw * values[east]
    for name, here_m in zip("xyz", position_ned_m, strict=True):
        local[name] += here_m
    return local


def motion_setpoint(values: Mapping[str, Any]) -> MotionSetpoint | None:
    """SET_POSITION_TARGET_LOCAL_NED in MAV_FRAME 1; a vector with one ignored component is ignored.

    The vehicle stops at a setpoint that it cannot fly: an unknown frame, no demand, a position
    with an acceleration and no velocity, a velocity that is not finite. None (ignored without an
    answer): a force, and other values that are not finite.
    """
    mask = values["type_mask"]

    def given(names: tuple[str, str, str], bits: int) -> Triple:
        if mask & bits:
            return NAN3
        a, b, c = (values[name] for name in names)
        return (a, b, c)

    position = given(("x", "y", "z"), _POSITION)
    velocity = given(("vx", "vy", "vz"), _VELOCITY)
    acceleration = given(("afx", "afy", "afz"), _ACCELERATION)
    if mask & _FORCE and not mask & _ACCELERATION:
        return None
    by_velocity, by_acceleration = not mask & _VELOCITY, not mask & _ACCELERATION
    unflyable = not by_velocity and bool(mask & _POSITION) is not by_acceleration
    if values["coordinate_frame"] != _LOCAL_NED or unflyable:
        return _STOP
    if by_velocity and not all(map(math.isfinite, velocity)):
        return _STOP
    yaw = math.nan if mask & _YAW else values["yaw"]
    yaw_rate = math.nan if mask & _YAW_RATE else values["yaw_rate"]
    numbers = (*position, *velocity, *acceleration)
    if any(map(math.isinf, (*numbers, yaw, yaw_rate))) or all(map(math.isnan, numbers)):
        return None
    along = bool(mask & _YAW and mask & _YAW_RATE)
    return MotionSetpoint(position, velocity, acceleration, yaw, yaw_rate, along)


def rejection_text(message: str, frame: int | None) -> None:
    """No text."""


SETPOINTS = SetpointRules(
    attitude=attitude_setpoint,
    motion=motion_setpoint,
    in_local_frame=in_local_frame,
    home_mirrored=False,
    global_frames=frozenset({0, 3, 5, 6, 10, 11}),
    rejection=rejection_text,
    mode_needs_stream=False,
    as_automatic=True,
    outlive_modes=False,
    imply_flight=True,
    spool_s=2.8,
    reaction_s=0.0,
)
