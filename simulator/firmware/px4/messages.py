"""Builders of messages that only PX4 sends; fields in the order of the XML."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from simulator.autopilot.position_loop import GRAVITY_MPS2
from simulator.mavlink.fields import centi, fit, in_body, pressure_hpa
from simulator.mavlink.view import View

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


def current_mode(view: View) -> Sequence[Any]:
    """The mode in force, and the one that was chosen: they differ in a failsafe."""
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
    return (view.time_us, amsl, amsl, -down, relative, math.nan, math.nan)


def highres_imu(view: View) -> Sequence[Any]:
    """True specific force in body axes, estimated rates."""
    nav = view.autopilot.state.estimate
    w, x, y, z, *_, down, a_north, a_east, a_down = view.autopilot.plant.motion()
    force = in_body((w, x, y, z), (a_north, a_east, a_down - GRAVITY_MPS2))
    height = view.autopilot.firmware.origin[2] - down
    return (
        view.time_us,
        *force,
        *nav.rates_frd_radps,
        *(0.21, 0.0, 0.43),
        pressure_hpa(height),
        0.0,
        height,
        15.0,
        0x1BFF,
        0,
    )


def hil_state_quaternion(view: View) -> Sequence[Any]:
    """True state. Latitude and longitude have a resolution of 1 cm."""
    truth = view.autopilot.state.truth
    north, east, down = truth.position_ned_m.tolist()
    a, b, c = (
        fit(value / GRAVITY_MPS2 * 1e3, 16) for value in truth.acceleration_ned_mps2.tolist()
    )
    v_north, v_east, v_down = truth.velocity_ned_mps.tolist()
    airspeed = fit(math.hypot(v_north, v_east) * 100, 16, signed=False)
    return (
        view.time_us,
        truth.attitude.tolist(),
        *truth.rates_frd_radps.tolist(),
        *view.geodetic(north, east),
        view.altitude_mm(down),
        *centi((v_north, v_east, v_down)),
        airspeed,
        airspeed,
        a,
        b,
        c,
    )


def estimator_status(view: View) -> Sequence[Any]:
    autopilot = view.autopilot
    flags = 895 if autopilot.health.has_fix(autopilot.state.time_s) else 1024
    if autopilot.monitors.position_lost:
        flags = 229
    velocity_ratio = max(0.12, autopilot.commander.velocity_ratio)
    # PX4 1.16 SIH without GPS: 0.5 m after 1.7 s, 1.0 after 3.7, 2.2 after 6.7, 4.9 after 10.8
    passed_s = autopilot.monitors.without_fix_s(autopilot.state.time_s)
    accuracy_m = 0.3 + (0.05 * passed_s + 0.035 * passed_s**2 if math.isfinite(passed_s) else 0.0)
    return (
        view.time_us, flags, velocity_ratio, 0.03, 0.03, 0.14, 0.02, math.nan, accuracy_m, 0.31
    )  # fmt: skip


def ping(view: View) -> Sequence[Any]:
    view.ping_sequence += 1
    return (view.time_us, view.ping_sequence & 0xFFFFFFFF, 0, 0)
