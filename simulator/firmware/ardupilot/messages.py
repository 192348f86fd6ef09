"""Messages that ArduPilot sends and PX4 does not, as field values in the order of the XML."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from offboard.model.frames import euler_from_quaternion, rotation_from_quaternion
from simulator.position_loop import GRAVITY_MPS2
from simulator.telemetry import View

# EKF_STATUS_FLAGS from a boot event on
_EKF_FLAGS = (("position", 831), ("attitude", 167), ("aligning", 0))
_EKF_UNINITIALISED = 1024
# The sticks that SITL feigns: throttle down, mode switch
_STICKS = (1500, 1500, 1000, 1500, 1800, 1000, 1000, 1800)
_PWM_LEAST, _PWM_SPAN = 1000, 1000


def _specific_force(view: View) -> tuple[float, float, float]:
    """What an accelerometer would show, FRD, m/s^2."""
    truth = view.autopilot.senses.truth
    force_ned = truth.acceleration_ned_mps2.copy()
    force_ned[2] -= GRAVITY_MPS2
    x, y, z = (rotation_from_quaternion(truth.attitude).T @ force_ned).tolist()
    return x, y, z


def simstate(view: View) -> Sequence[Any]:
    """The truth, without height and velocity."""
    truth = view.autopilot.senses.truth
    north, east, _ = truth.position_ned_m.tolist()
    return (
        *euler_from_quaternion(truth.attitude).tolist(),
        *_specific_force(view),
        *truth.rates_frd_radps.tolist(),
        *view.geodetic(north, east),
    )


def sim_state(view: View) -> Sequence[Any]:
    """The truth. It carries no time stamp; latitude and longitude are in steps of 1 cm."""
    truth = view.autopilot.senses.truth
    north, east, down = truth.position_ned_m.tolist()
    latitude, longitude = view.geodetic(north, east)
    return (
        *truth.attitude.tolist(),
        *euler_from_quaternion(truth.attitude).tolist(),
        *_specific_force(view),
        *truth.rates_frd_radps.tolist(),
        latitude * 1e-7,
        longitude * 1e-7,
        view.altitude_mm(down) * 1e-3,
        0.0,
        0.0,
        *truth.velocity_ned_mps.tolist(),
        latitude,
        longitude,
    )


def ekf_status_report(view: View) -> Sequence[Any]:
    """EKF_STATUS_REPORT: flags grow as the estimate does; variances as of a good one."""
    reached = view.autopilot.health.reached
    if view.autopilot.watch.position_lost:
        reached -= {"position"}
    flags = next((bits for event, bits in _EKF_FLAGS if event in reached), _EKF_UNINITIALISED)
    return (flags, 0.02, 0.02, 0.02, 0.01, 0.0, 0.0)


def raw_imu(view: View) -> Sequence[Any]:
    """Milli-g, millirad/s, milligauss; 25 degrees."""
    force = (_int16(value / GRAVITY_MPS2 * 1e3) for value in _specific_force(view))
    rates = (_int16(value * 1e3) for value in view.autopilot.senses.look().rates_frd_radps)
    return (view.time_us, *force, *rates, 224, 80, -528, 0, 2500)


def _int16(value: float) -> int:
    return round(min(32767.0, max(-32768.0, value))) if math.isfinite(value) else 0


def servo_output_raw(view: View) -> Sequence[Any]:
    """SERVO_OUTPUT_RAW: four motors, us, by the collective thrust."""
    pwm = _PWM_LEAST + round(_PWM_SPAN * view.autopilot.pilot.demand.thrust)
    return (view.time_us & 0xFFFFFFFF, 0, *(pwm,) * 4, *(0,) * 12)


def rc_channels(view: View) -> Sequence[Any]:
    """RC_CHANNELS: sticks that nobody touches."""
    return (view.time_ms, len(_STICKS), *_STICKS, *(0,) * (18 - len(_STICKS)), 255)


MESSAGES: Mapping[str, Callable[[View], Sequence[Any]]] = {
    builder.__name__.upper(): builder
    for builder in (simstate, sim_state, ekf_status_report, raw_imu, servo_output_raw, rc_channels)
}
