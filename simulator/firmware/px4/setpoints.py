"""How PX4 reads setpoint messages, including those that it should refuse."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from offboard.model.frames import rotation_from_quaternion
from simulator.firmware.base import SetpointRules
from simulator.firmware.values import (
    AttitudeSetpoint,
    MotionSetpoint,
    Quaternion,
    ReadParameter,
    StatusText,
    Triple,
    critical,
)

_RATES_IGNORED, _THRUST_IGNORED, _ATTITUDE_IGNORED = 0b011, 64, 128


def attitude_setpoint(values: Mapping[str, Any], _: ReadParameter) -> AttitudeSetpoint | None:
    """SET_ATTITUDE_TARGET as PX4 reads it; None when it demands nothing (mask 135).

    Only the roll and pitch bits of type_mask ignore the rates. A thrust that is ignored or NaN is
    zero thrust. A quaternion may have any length; one without direction keeps the last attitude.
    """
    mask = values["type_mask"]
    attitude_given = not mask & _ATTITUDE_IGNORED
    rates_given = not mask & _RATES_IGNORED
    if not attitude_given and not rates_given:
        return None
    thrust = 0.0 if mask & _THRUST_IGNORED else values["thrust"]
    thrust = min(1.0, max(0.0, thrust)) if not math.isnan(thrust) else 0.0
    if attitude_given:
        w, x, y, z = values["q"]
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        if not (math.isfinite(norm) and norm > 1e-6):
            return AttitudeSetpoint(None, None, thrust)
        return AttitudeSetpoint((w / norm, x / norm, y / norm, z / norm), None, thrust)
    rates = (values["body_roll_rate"], values["body_pitch_rate"], values["body_yaw_rate"])
    finite: Triple = (
        rates[0] if math.isfinite(rates[0]) else 0.0,
        rates[1] if math.isfinite(rates[1]) else 0.0,
        rates[2] if math.isfinite(rates[2]) else 0.0,
    )
    return AttitudeSetpoint(None, finite, thrust)


_LOCAL_NED, _BODY_NED = 1, 8  # MAV_FRAME
_YAW_IGNORED, _YAW_RATE_IGNORED = 1024, 2048


def in_local_frame(values: Mapping[str, Any], _: Triple, attitude: Quaternion) -> Mapping[str, Any]:
    """BODY_NED: velocity rotated by yaw, acceleration by attitude, no position.

    A vector with one ignored component is ignored.
    """
    if values["coordinate_frame"] != _BODY_NED:
        return values
    w, x, y, z = attitude
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    forward, right = values["vx"], values["vy"]
    given = (values["afx"], values["afy"], values["afz"])
    finite = all(map(math.isfinite, given))
    turned = rotation_from_quaternion(np.array(attitude)) @ given if finite else given
    mask = values["type_mask"] | 0b111
    mask |= 0b111_000 if mask & 0b111_000 else 0
    mask |= 0b111_000_000 if mask & 0b111_000_000 else 0
    return {
        **values,
        "coordinate_frame": _LOCAL_NED,
        "type_mask": mask,
        "vx": math.cos(yaw) * forward - math.sin(yaw) * right,
        "vy": math.sin(yaw) * forward + math.cos(yaw) * right,
        "afx": float(turned[0]),
        "afy": float(turned[1]),
        "afz": float(turned[2]),
    }


def rejection_text(message: str, frame: int | None) -> StatusText:
    """Text about a setpoint in an unknown frame, or (None) one that demands nothing."""
    if frame is None:
        return critical(f"{message} invalid")
    if message.endswith("GLOBAL_INT"):
        return critical(f"{message} invalid coordinate frame {frame}")
    return critical(f"{message} coordinate frame {frame} unsupported")


def motion_setpoint(values: Mapping[str, Any]) -> MotionSetpoint | None:
    """SET_POSITION_TARGET_LOCAL_NED in MAV_FRAME 1; None when nothing is demanded."""
    if values["coordinate_frame"] != _LOCAL_NED:
        return None
    mask = values["type_mask"]

    def triple(names: tuple[str, str, str], shift: int) -> Triple:
        a, b, c = (
            math.nan if mask >> (shift + i) & 1 or math.isinf(values[name]) else values[name]
            for i, name in enumerate(names)
        )
        return (a, b, c)

    position = triple(("x", "y", "z"), 0)
    velocity = triple(("vx", "vy", "vz"), 3)
    acceleration = triple(("afx", "afy", "afz"), 6)
    if all(math.isnan(value) for value in (*position, *velocity, *acceleration)):
        return None
    yaw, yaw_rate = values["yaw"], values["yaw_rate"]
    return MotionSetpoint(
        position,
        velocity,
        acceleration,
        math.nan if mask & _YAW_IGNORED or math.isinf(yaw) else yaw,
        math.nan if mask & _YAW_RATE_IGNORED or math.isinf(yaw_rate) else yaw_rate,
    )


SETPOINTS = SetpointRules(
    attitude=attitude_setpoint,
    motion=motion_setpoint,
    in_local_frame=in_local_frame,
    home_mirrored=True,
    global_frames=frozenset({5, 6, 11}),
    rejection=rejection_text,
    mode_needs_stream=True,
    as_automatic=False,
    outlive_modes=True,
    imply_flight=False,
    spool_s=0.0,
    reaction_s=0.036,
)
