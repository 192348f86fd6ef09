"""Builders of messages that only ArduPilot sends; fields in the order of the XML."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from offboard.model.frames import euler_from_quaternion, rotation_from_quaternion
from simulator.autopilot.position_loop import GRAVITY_MPS2
from simulator.mavlink.fields import fit
from simulator.mavlink.view import View

# EKF_STATUS_FLAGS from a boot event on
_EKF_FLAGS = (("position", 831), ("attitude", 167), ("aligning", 0))
_EKF_UNINITIALISED = 1024
_PWM_LEAST, _PWM_SPAN = 1000, 1000


def _specific_force(view: View) -> tuple[float, float, float]:
    """True specific force, FRD, m/s^2."""
    truth = view.autopilot.state.truth
    force_ned = truth.acceleration_ned_mps2.copy()
    force_ned[2] -= GRAVITY_MPS2
    x, y, z = (rotation_from_quaternion(truth.attitude).T @ force_ned).tolist()
    return x, y, z


def simstate(view: View) -> Sequence[Any]:
    """True state without height and velocity."""
    truth = view.autopilot.state.truth
    north, east, _ = truth.position_ned_m.tolist()
    return (
        *euler_from_quaternion(truth.attitude).tolist(),
        *_specific_force(view),
        *truth.rates_frd_radps.tolist(),
        *view.geodetic(north, east),
    )


def sim_state(view: View) -> Sequence[Any]:
    """True state without time stamp; latitude and longitude have a resolution of 1 cm."""
    truth = view.autopilot.state.truth
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
    """Flags by the boot events so far; variances of a good estimate, but for a wrong velocity."""
    reached = view.autopilot.health.reached
    if view.autopilot.monitors.position_lost:
        reached -= {"position"}
    flags = next((bits for event, bits in _EKF_FLAGS if event in reached), _EKF_UNINITIALISED)
    velocity_ratio = max(0.02, view.autopilot.commander.velocity_ratio)
    return (flags, velocity_ratio, 0.02, 0.02, 0.01, 0.0, 0.0)


def raw_imu(view: View) -> Sequence[Any]:
    """Milli-g, millirad/s, milligauss; 25 degrees."""
    force = (fit(value / GRAVITY_MPS2 * 1e3, 16) for value in _specific_force(view))
    rates = (fit(value * 1e3, 16) for value in view.autopilot.state.estimate.rates_frd_radps)
    return (view.time_us, *force, *rates, 224, 80, -528, 0, 2500)


def servo_output_raw(view: View) -> Sequence[Any]:
    """Four motors, us, from the collective thrust."""
    pwm = _PWM_LEAST + round(_PWM_SPAN * view.autopilot.pilot.demand.thrust)
    return (view.time_us & 0xFFFFFFFF, 0, *(pwm,) * 4, *(0,) * 12)


def rc_channels(view: View) -> Sequence[Any]:
    """The channels of SITL without RC, or those of RC_CHANNELS_OVERRIDE."""
    sticks, now_s = view.autopilot.guidance.sticks, view.autopilot.state.time_s
    widths_us = () if sticks is None else sticks.pulses_us(now_s)
    return (view.time_ms, len(widths_us), *widths_us, *(0,) * (18 - len(widths_us)), 255)


def scaled_imu2(view: View) -> Sequence[Any]:
    """As RAW_IMU."""
    _, *values, _, temperature = raw_imu(view)
    return (view.time_ms, *values, temperature)


def ahrs(_: View) -> Sequence[Any]:
    """No drift; errors of a good estimate."""
    return (0.0, 0.0, 0.0, 0.0, 0.0, 0.003, 0.005)


def ahrs2(view: View) -> Sequence[Any]:
    """The estimate in radians and AMSL metres."""
    nav = view.autopilot.state.estimate
    north, east, down = nav.position_ned_m
    euler = euler_from_quaternion(np.array(nav.attitude)).tolist()
    return (*euler, view.altitude_mm(down) * 1e-3, *view.geodetic(north, east))


def meminfo(_: View) -> Sequence[Any]:
    """Constants of SITL."""
    return (0, 65535, 524288)


def power_status(_: View) -> Sequence[Any]:
    """Board voltage in mV."""
    return (5000, 0, 0)


def wind(_: View) -> Sequence[Any]:
    """No wind: it is not estimated without an airspeed sensor."""
    return (-180.0, 0.0, 0.0)


def nav_controller_output(view: View) -> Sequence[Any]:
    """Demanded attitude in degrees; distance and bearing to the position setpoint."""
    nav, pilot = view.autopilot.state.estimate, view.autopilot.pilot
    wanted = pilot.demand.attitude or (1.0, 0.0, 0.0, 0.0)
    roll, pitch, yaw = np.degrees(euler_from_quaternion(np.array(wanted))).tolist()
    place = pilot.motion.position_ned_m
    left = [there - here for there, here in zip(place, nav.position_ned_m, strict=True)]
    north, east, down = (value if math.isfinite(value) else 0.0 for value in left)
    distance_m = round(min(65535.0, math.hypot(north, east)))
    bearing_deg = round(math.degrees(math.atan2(east, north))) if distance_m else 0
    return (roll, pitch, round(yaw), bearing_deg, distance_m, -down, 0.0, 0.0)


def position_target_global_int(view: View) -> Sequence[Any]:
    """Position setpoint with AMSL height; the present position where there is none."""
    pilot, here = view.autopilot.pilot, view.autopilot.state.estimate.position_ned_m
    place = pilot.motion.position_ned_m
    north, east, down = (p if math.isfinite(p) else h for p, h in zip(place, here, strict=True))
    amsl_m = view.altitude_mm(down) * 1e-3
    return (view.time_ms, 0, 65016, *view.geodetic(north, east), amsl_m, *(0.0,) * 8)


_NO_MISSION, _NOT_STARTED, _ACTIVE, _PAUSED, _COMPLETE = range(1, 6)  # MISSION_STATE


def mission_current(view: View) -> Sequence[Any]:
    """Number of items without home; before the start the current item is home (0)."""
    mission = view.autopilot.mission
    begun = mission.under_way or mission.reached >= 0 or mission.current > mission.first
    state = _NO_MISSION
    if mission.flyable:
        state = _PAUSED if begun else _NOT_STARTED
        state = _ACTIVE if mission.under_way else state
        state = _COMPLETE if mission.finished else state
    number = mission.current if begun else 0
    return (number, max(0, len(mission.items) - 1), state, 0)
