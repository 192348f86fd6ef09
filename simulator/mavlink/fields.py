"""Conversion of SI values to fields of MAVLink messages: scaled, rounded, limited to their range.

All unit conversions of telemetry are here. Knows no vehicle and no message.
"""

from __future__ import annotations

import math

from simulator.firmware.values import MotionSetpoint, Quaternion, Triple

_RANGES = {
    (bits, signed): (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    for bits in (8, 16, 32)
    for signed in (False, True)
}


def fit(value: float, bits: int, *, signed: bool = True) -> int:
    """`value` rounded and limited to an integer of `bits`; 0 if it is not finite."""
    if value - value != 0.0:  # infinite or not a number
        return 0
    low, high = _RANGES[bits, signed]
    return min(high, max(low, round(value)))


def centi(velocity: Triple) -> tuple[int, int, int]:
    """m/s -> cm/s, int16."""
    return fit(velocity[0] * 100, 16), fit(velocity[1] * 100, 16), fit(velocity[2] * 100, 16)


def heading_cdeg(yaw_rad: float) -> int:
    """Yaw -> centidegrees 0 .. 35999; 0 if it is not finite."""
    return fit(math.degrees(yaw_rad) * 100, 32) % 36000


def pressure_hpa(height_m: float) -> float:
    """Pressure of the standard atmosphere at this height above the sea; 0 above 44 km."""
    return 1013.25 * math.pow(max(0.0, 1.0 - 2.25577e-5 * height_m), 5.25588)


def in_body(attitude: Quaternion, vector_ned: Triple) -> Triple:
    """An NED vector in body axes: v + 2 r x (r x v - w v) with the quaternion (w, r)."""
    w, x, y, z = attitude
    north, east, down = vector_ned
    a, b, c = y * down - z * east, z * north - x * down, x * east - y * north
    a, b, c = a - w * north, b - w * east, c - w * down
    return (
        north + 2.0 * (y * c - z * b),
        east + 2.0 * (z * a - x * c),
        down + 2.0 * (x * b - y * a),
    )


def motion_fields(motion: MotionSetpoint) -> tuple[float, ...]:
    """A setpoint as the fields of POSITION_TARGET_LOCAL_NED: NED, SI, NaN where not demanded."""
    return (
        *motion.position_ned_m,
        *motion.velocity_ned_mps,
        *motion.acceleration_ned_mps2,
        motion.yaw_rad,
        motion.yaw_rate_radps,
    )
