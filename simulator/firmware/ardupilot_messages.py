"""Telemetry of ArduCopter: rates, and builders of the messages that only ArduCopter sends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from offboard.model.frames import euler_from_quaternion
from simulator.autopilot.mission import Kind
from simulator.autopilot.values import AttitudeSetpoint
from simulator.firmware.ardupilot_tables import BY_HAND, BY_POSITION
from simulator.mavlink import messages
from simulator.mavlink.view import View, fit

COMPANION_RATES_HZ = GROUND_RATES_HZ = {"HEARTBEAT": 1.0, "TIMESYNC": 0.1}

# MAV_DATA_STREAM
GROUPS = {
    1: ("RAW_IMU", "SCALED_PRESSURE", "SCALED_PRESSURE2"),
    2: (
        "SYS_STATUS", "MISSION_CURRENT", "GPS_RAW_INT", "NAV_CONTROLLER_OUTPUT",
        "POSITION_TARGET_GLOBAL_INT", "POWER_STATUS", "MEMINFO",
    ),
    3: ("RC_CHANNELS", "SERVO_OUTPUT_RAW"),
    6: ("GLOBAL_POSITION_INT", "LOCAL_POSITION_NED"),
    10: ("ATTITUDE", "AHRS2"),
    11: ("VFR_HUD",),
    12: ("SYSTEM_TIME", "BATTERY_STATUS", "EKF_STATUS_REPORT", "VIBRATION", "WIND"),
}  # fmt: skip
NEVER_SENT = frozenset({
    22, 26, 34, 35, 100, 105, 116, 124, 127, 128, 129, 132, 133, 136,
    143, 162, 163, 164, 165, 173, 180, 191, 192, 194, 195, 225, 226, 235, 246,
    259, 260, 262, 269, 271, 277, 280, 281, 285, 286, 295, 301, 373, 376, 9005,
})  # fmt: skip

# EKF_STATUS_FLAGS after a boot event; the first event that was reached counts
_EKF_FLAGS = (("position", 831), ("attitude", 167), ("aligning", 0))
_EKF_UNINITIALISED = 1024


def heartbeat(view: View) -> Sequence[Any]:
    """MAV_STATE: 1 booting, 3 on the ground, 4 in the air, 5 in a failsafe or a latched error."""
    autopilot, commander = view.autopilot, view.autopilot.commander
    if "initialised" not in autopilot.health.reached:
        return view.heartbeat(BY_POSITION, 1)
    by_hand = isinstance(autopilot.guidance.newest, AttitudeSetpoint)
    base_mode = BY_HAND if by_hand else commander.mode.base_mode
    if commander.latched or commander.failsafe:
        return view.heartbeat(base_mode, 5)
    in_air = commander.armed and not autopilot.position_controller.landed
    return view.heartbeat(base_mode, 4 if in_air else 3)


def global_position_int(view: View) -> Sequence[Any]:
    """Zeros before the first GPS fix."""
    time_ms, *values, heading_cdeg = messages.global_position_int(view)
    known = "fix" in view.autopilot.health.reached
    return (time_ms, *(values if known else (0,) * len(values)), heading_cdeg)


def sim_state(view: View) -> Sequence[Any]:
    """True state, without time stamp; latitude and longitude have a resolution of 1 cm."""
    truth = view.autopilot.state.truth
    north, east, down = truth.position_ned_m
    latitude, longitude = view.geodetic(north, east)
    return (
        *truth.attitude,
        *euler_from_quaternion(truth.attitude).tolist(),
        *view.specific_force,
        *truth.rates_frd_radps,
        latitude * 1e-7,
        longitude * 1e-7,
        view.altitude_mm(down) * 1e-3,
        0.0,
        0.0,
        *truth.velocity_ned_mps,
        latitude,
        longitude,
    )


def ekf_status_report(view: View) -> Sequence[Any]:
    """Flags from the boot events so far; variances of a good estimate, except the velocity's."""
    reached = view.autopilot.health.reached
    if view.autopilot.health.position_lost:
        reached -= {"position"}
    flags = next((bits for event, bits in _EKF_FLAGS if event in reached), _EKF_UNINITIALISED)
    velocity_ratio = max(0.02, view.autopilot.commander.velocity_ratio)
    position_ratio = view.autopilot.health.position_ratio(0.02)
    return (flags, velocity_ratio, position_ratio, 0.02, 0.01, 0.0, 0.0)


def rc_channels(view: View) -> Sequence[Any]:
    """The channels of SITL without RC, or those of RC_CHANNELS_OVERRIDE."""
    autopilot = view.autopilot
    widths_us = autopilot.guidance.sticks.pulses_us(autopilot.state.time_s)
    return (view.time_ms, len(widths_us), *widths_us, *(0,) * (18 - len(widths_us)), 255)


def raw_imu(view: View) -> Sequence[Any]:
    """True specific force in mg, estimated rates in mrad/s, magnetic field of SITL in mgauss."""
    return (view.time_us, *view.scaled_imu, 224, 80, -528, 0, 2500)


def servo_output_raw(view: View) -> Sequence[Any]:
    """Four equal motors, with MOT_THST_EXPO and MOT_SPIN_MIN to MOT_SPIN_MAX (0.15 to 0.95)."""
    demand = view.autopilot.position_controller.demand
    bend = max(1e-3, view.autopilot.parameters["MOT_THST_EXPO"])
    root = math.sqrt(max(0.0, (1.0 - bend) ** 2 + 4.0 * bend * demand.thrust))
    width_us = 1150 + 800 * (bend - 1.0 + root) / (2.0 * bend) if demand.motors_on else 1000
    width_us = fit(width_us, 16, signed=False)
    return (view.time_us & 0xFFFFFFFF, 0, *(width_us,) * 4, *view.autopilot.outputs_us[4:])


def nav_controller_output(view: View) -> Sequence[Any]:
    """Demanded roll and pitch, yaw, and distance to the place that is flown to, 0 without one."""
    autopilot = view.autopilot
    motion, here = autopilot.position_controller.motion, autopilot.state.estimate.position_ned_m
    north, east, down = (
        there - at if math.isfinite(there) else 0.0
        for there, at in zip(motion.position_ned_m, here, strict=True)
    )
    attitude = autopilot.position_controller.demand.attitude or (1.0, 0.0, 0.0, 0.0)
    roll, pitch, _ = euler_from_quaternion(attitude).tolist()
    distance_m = math.hypot(north, east)
    bearing_deg = round(math.degrees(math.atan2(east, north))) if distance_m >= 1.0 else 0
    return (
        math.degrees(roll), math.degrees(pitch),
        round(math.degrees(autopilot.state.estimate.yaw_rad)), bearing_deg % 360,
        fit(distance_m, 16, signed=False), -down, 0.0, 0.0,
    )  # fmt: skip


_NO_MISSION, _NOT_STARTED, _ACTIVE, _PAUSED, _COMPLETE = range(1, 6)  # MISSION_STATE


def mission_current(view: View) -> Sequence[Any]:
    """The number of items is without home; before the start, the current item is home (0). A
    return is part of the mission, in mode AUTO."""
    mission, in_auto = view.autopilot.mission, view.autopilot.commander.mode.name == "AUTO"
    begun = mission.under_way or mission.reached >= 0 or mission.current > mission.first
    state = _NO_MISSION
    if mission.flyable:
        state = _PAUSED if begun else _NOT_STARTED
        state = _ACTIVE if mission.under_way else state
        if mission.finished:
            returns = in_auto and mission.items[mission.current].command == Kind.RETURN
            state = _ACTIVE if returns else _COMPLETE
    number = mission.current if begun else 0
    return (number, max(0, len(mission.items) - 1), state, int(in_auto))


def ahrs2(view: View) -> Sequence[Any]:
    """The second estimator: it agrees with the first one."""
    _, latitude, longitude, height_mm, *_ = messages.global_position_int(view)
    return (*messages.attitude(view)[1:4], height_mm * 1e-3, latitude, longitude)


def meminfo(view: View) -> Sequence[Any]:
    return (0, 65535, 524288)


def power_status(view: View) -> Sequence[Any]:
    """5 V."""
    return (5000, 0, 0)


def scaled_pressure2(view: View) -> Sequence[Any]:
    return messages.scaled_pressure(view)


def wind(view: View) -> Sequence[Any]:
    """None: without an airspeed sensor, no wind is estimated."""
    return (-180.0, 0.0, 0.0)
