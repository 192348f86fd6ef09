"""Telemetry of PX4: rates, and builders of the messages that only PX4 sends."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from typing import Any

from simulator.autopilot.values import AttitudeSetpoint, Behaviour
from simulator.firmware.px4_tables import OFFBOARD, RATES
from simulator.geodesy import GRAVITY_MPS2
from simulator.mavlink.view import View, centi, fit, pressure_hpa

COMPANION_RATES_HZ = {
    "HEARTBEAT": 1.0,
    "ATTITUDE": 100.0,
    "ATTITUDE_QUATERNION": 50.0,
    "GLOBAL_POSITION_INT": 50.0,
    "HIGHRES_IMU": 50.0,
    "LOCAL_POSITION_NED": 30.0,
    "ODOMETRY": 30.0,
    "ALTITUDE": 10.0,
    "ATTITUDE_TARGET": 10.0,
    "DISTANCE_SENSOR": 10.0,
    "POSITION_TARGET_LOCAL_NED": 10.0,
    "SERVO_OUTPUT_RAW": 10.0,
    "TIMESYNC": 10.0,
    "VFR_HUD": 10.0,
    "GPS_RAW_INT": 8.0,
    "SYS_STATUS": 5.0,
    "EXTENDED_SYS_STATE": 5.0,
    "ESTIMATOR_STATUS": 1.0,
    "SYSTEM_TIME": 1.0,
    "MISSION_CURRENT": 1.0,
    "SCALED_PRESSURE": 1.0,
    "BATTERY_STATUS": 0.5,
    "CURRENT_MODE": 0.5,
    "HOME_POSITION": 0.5,
    "VIBRATION": 0.5,
}

GROUND_RATES_HZ = {
    "HEARTBEAT": 1.0,
    "ATTITUDE": 15.0,
    "ATTITUDE_QUATERNION": 10.0,
    "GLOBAL_POSITION_INT": 5.0,
    "GPS_RAW_INT": 5.0,
    "VFR_HUD": 4.0,
    "ATTITUDE_TARGET": 2.0,
    "POSITION_TARGET_LOCAL_NED": 1.5,
    "ALTITUDE": 1.0,
    "LOCAL_POSITION_NED": 1.0,
    "SYS_STATUS": 1.0,
    "EXTENDED_SYS_STATE": 1.0,
    "SERVO_OUTPUT_RAW": 1.0,
    "SYSTEM_TIME": 1.0,
    "MISSION_CURRENT": 1.0,
    "ESTIMATOR_STATUS": 0.5,
    "BATTERY_STATUS": 0.5,
    "CURRENT_MODE": 0.5,
    "DISTANCE_SENSOR": 0.5,
    "HOME_POSITION": 0.5,
}


ON_EVENT = frozenset({"MISSION_CURRENT", "MISSION_ITEM_REACHED"})
NEVER_SENT = frozenset({
    8, 25, 62, 65, 69, 76, 93, 106, 112, 116, 124, 129, 137, 143, 149,
    192, 225, 231, 233, 235, 246, 250, 251, 253, 254, 261, 263, 265, 280, 281, 283,
    284, 285, 286, 290, 291, 300, 330, 339, 350, 360, 361, 371, 372, 380, 395, 397, 435,
    12900, 12901, 12904, 12918, 12920,
})  # fmt: skip

_NAN21 = (math.nan,) * 21
# MAV_STANDARD_MODE; 0 for other modes
_STANDARD_MODES = {
    "POSCTL": 1,
    "ALTCTL": 4,
    "AUTO.RTL": 5,
    "AUTO.MISSION": 6,
    "AUTO.LAND": 7,
    "AUTO.TAKEOFF": 8,
}


def heartbeat(view: View) -> Sequence[Any]:
    """In OFFBOARD, base_mode shows which control loops run: none before the first setpoint, only
    the rate loop with rate setpoints."""
    commander, setpoint = view.autopilot.commander, view.autopilot.guidance.newest
    base_mode = commander.mode.base_mode
    if commander.mode.behaviour is Behaviour.SETPOINT:
        rates = isinstance(setpoint, AttitudeSetpoint) and setpoint.rates_frd_radps is not None
        base_mode = RATES if setpoint is None or rates else OFFBOARD
    if commander.armed:
        return view.heartbeat(base_mode, 5 if commander.failsafe else 4)
    terminated = 8 if commander.latched else 0
    return view.heartbeat(base_mode, 3 if commander.healthy else terminated)


def current_mode(view: View) -> Sequence[Any]:
    """The present mode and the one that was chosen; they differ in a failsafe."""
    commander = view.autopilot.commander
    standard = _STANDARD_MODES.get(commander.mode.name, 0)
    return (standard, commander.mode.custom_mode, commander.intended.custom_mode)


def odometry(view: View) -> Sequence[Any]:
    nav = view.autopilot.state.estimate
    frame = 1  # MAV_FRAME_LOCAL_NED, velocities too, as PX4 sends it
    return (
        view.time_us,
        frame,
        frame,
        *nav.position_ned_m,
        nav.attitude,
        *nav.velocity_ned_mps,
        *nav.rates_frd_radps,
        _NAN21,
        _NAN21,
        nav.reset_counter,
        8,  # MAV_ESTIMATOR_TYPE_AUTOPILOT
        0,
    )


def altitude(view: View) -> Sequence[Any]:
    down = view.autopilot.state.estimate.position_ned_m[2]
    amsl = view.altitude_mm(down) / 1e3
    relative = view.autopilot.guidance.home_ned_m[2] - down
    ground_m = view.autopilot.state.estimate.ground_m
    return (view.time_us, amsl, amsl, -down, relative, -down - ground_m, ground_m)


def distance_sensor(view: View) -> Sequence[Any]:
    """The range finder of PX4's SIH, which points down; cm."""
    range_cm = fit(view.autopilot.state.estimate.ground_m * 100.0, 16, signed=False)
    return (view.time_ms, 0, 10_000, range_cm, 0, 0, 25, 0)


def servo_output_raw(view: View) -> Sequence[Any]:
    """Four equal motors; a motor that is off has 900 us."""
    demand = view.autopilot.position_controller.demand
    width_us = fit(1000.0 + 1000.0 * demand.thrust if demand.motors_on else 900, 16, signed=False)
    return (view.time_us & 0xFFFFFFFF, 0, *(width_us,) * 4, *(900,) * 12)


def actuator_output_status(view: View) -> Sequence[Any]:
    """The pulse widths of SERVO_OUTPUT_RAW."""
    return (view.time_us, 16, (*servo_output_raw(view)[2:], *(0.0,) * 16))


def scaled_imu(view: View) -> Sequence[Any]:
    """The values of HIGHRES_IMU, but in mg, mrad/s and mgauss."""
    return (view.time_ms, *view.scaled_imu, 210, 0, 430, 1500)


def highres_imu(view: View) -> Sequence[Any]:
    """True specific force in body axes and estimated rates; PX4 sends the pressure in Pa."""
    nav = view.autopilot.state.estimate
    height = view.autopilot.firmware.origin[2] + view.autopilot.plant.height_m
    return (
        view.time_us,
        *view.specific_force,
        *nav.rates_frd_radps,
        *(0.21, 0.0, 0.43),
        pressure_hpa(height) * 100.0,
        0.0,
        height,
        15.0,
        0x1BFF,
        0,
    )


def hil_state_quaternion(view: View) -> Sequence[Any]:
    """True state. Latitude and longitude have a resolution of 1 cm."""
    truth = view.autopilot.state.truth
    north, east, down = truth.position_ned_m
    v_north, v_east, _ = truth.velocity_ned_mps
    airspeed = fit(math.hypot(v_north, v_east) * 100, 16, signed=False)
    return (
        view.time_us,
        truth.attitude,
        *truth.rates_frd_radps,
        *view.geodetic(north, east),
        view.altitude_mm(down),
        *centi(truth.velocity_ned_mps),
        airspeed,
        airspeed,
        *(fit(value / GRAVITY_MPS2 * 1e3, 16) for value in truth.acceleration_ned_mps2),
    )


def flight_information(view: View) -> Sequence[Any]:
    """Times of arming and takeoff, in us since boot; 0 while disarmed."""
    health, armed = view.autopilot.health, view.autopilot.commander.armed
    since_s = (health.armed_s, health.took_off_s) if armed else (0.0, 0.0)
    return (view.time_ms, *(round(time_s * 1e6) for time_s in since_s), 0)


def estimator_status(view: View) -> Sequence[Any]:
    autopilot = view.autopilot
    flags = 895 if "fix" in autopilot.health.reached else 1024
    if autopilot.health.position_lost:
        flags = 229
    velocity_ratio = max(0.12, autopilot.commander.velocity_ratio)
    # Accuracy of PX4 1.16 SIH without GPS: 0.5 m after 1.7 s, 1.0 m after 3.7 s, 2.2 m after 6.7 s,
    # 4.9 m after 10.8 s
    passed_s = autopilot.health.without_fix_s(autopilot.state.time_s)
    accuracy_m = 0.3 + (0.05 * passed_s + 0.035 * passed_s**2 if math.isfinite(passed_s) else 0.0)
    position_ratio = autopilot.health.position_ratio(0.03)
    return (
        view.time_us, flags, velocity_ratio, position_ratio, 0.03, 0.14, 0.02, math.nan,
        accuracy_m, 0.31,
    )  # fmt: skip


_STATUS_STEPS = 125  # 0.5 s


def _vehicle_status(view: View) -> Hashable:
    """Version of the topic vehicle_status, published twice a second and when it changes."""
    commander, state = view.autopilot.commander, view.autopilot.state
    modes = (commander.mode, commander.intended)
    return (state.steps // _STATUS_STEPS, modes, commander.armed, commander.failsafe)


VERSIONS = {"CURRENT_MODE": _vehicle_status}
