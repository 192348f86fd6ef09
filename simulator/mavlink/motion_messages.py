"""Builders of messages about position, motion and setpoints.

One function per message, named like it, returns its fields in the order of the XML. Knows no links,
rates or sequence numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from simulator.mavlink.fields import centi, fit, heading_cdeg, motion_fields, pressure_hpa
from simulator.mavlink.view import View


def attitude(view: View) -> Sequence[Any]:
    nav = view.autopilot.state.estimate
    w, x, y, z = nav.attitude
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x))))
    return (view.time_ms, roll, pitch, nav.yaw_rad, *nav.rates_frd_radps)


def attitude_quaternion(view: View) -> Sequence[Any]:
    nav = view.autopilot.state.estimate
    return (view.time_ms, *nav.attitude, *nav.rates_frd_radps, (0.0, 0.0, 0.0, 0.0))


def local_position_ned(view: View) -> Sequence[Any]:
    nav = view.autopilot.state.estimate
    return (view.time_ms, *nav.position_ned_m, *nav.velocity_ned_mps)


def global_position_int(view: View) -> Sequence[Any]:
    nav = view.autopilot.state.estimate
    north, east, down = nav.position_ned_m
    home_down = view.autopilot.guidance.home_ned_m[2]
    return (
        view.time_ms,
        *view.geodetic(north, east),
        view.altitude_mm(down),
        fit((home_down - down) * 1e3, 32),
        *centi(nav.velocity_ned_mps),
        heading_cdeg(nav.yaw_rad),
    )


def scaled_pressure(view: View) -> Sequence[Any]:
    """Static pressure in hPa; 25 degC."""
    down_m = view.autopilot.state.estimate.position_ned_m[2]
    height_m = view.autopilot.firmware.origin[2] - down_m
    return (view.time_ms, pressure_hpa(height_m), 0.0, 2500, 0)


def vibration(view: View) -> Sequence[Any]:
    """No vibration."""
    return (view.time_us, 0.0, 0.0, 0.0, 0, 0, 0)


def vfr_hud(view: View) -> Sequence[Any]:
    autopilot = view.autopilot
    nav = autopilot.state.estimate
    north, east, down = nav.velocity_ned_mps
    return (
        0.0,
        math.hypot(north, east),
        heading_cdeg(nav.yaw_rad) // 100,
        fit(autopilot.pilot.demand.thrust * 100, 16, signed=False),
        view.altitude_mm(nav.position_ned_m[2]) / 1e3,
        -down,
    )


def gps_raw_int(view: View) -> Sequence[Any]:
    """Accuracies as PX4's SIH reports them: larger than the errors."""
    if not view.has_fix:
        return (view.time_us, 1, 0, 0, 0, 65535, 65535, 65535, 65535, 0, *(0,) * 6)
    fix = view.autopilot.plant.fix
    north, east, down = fix.position_ned_m.tolist()
    v_north, v_east = fix.velocity_ne_mps.tolist()
    course = heading_cdeg(math.atan2(v_east, v_north))
    speed = fit(math.hypot(v_north, v_east) * 100, 16, signed=False)
    height = view.altitude_mm(down)
    latitude, longitude = view.geodetic(north, east)
    return (
        view.time_us, 3, latitude, longitude, height, 70, 110, speed, course, 10, height,
        900, 1780, 400, 0, 0,
    )  # fmt: skip


def attitude_target(view: View) -> Sequence[Any]:
    demand = view.autopilot.pilot.demand
    rates = demand.rates_frd_radps or (0.0, 0.0, 0.0)
    return (
        view.time_ms,
        0,
        demand.attitude or (1.0, 0.0, 0.0, 0.0),
        *rates,
        view.autopilot.pilot.thrust_demanded,
    )


def position_target_local_ned(view: View) -> Sequence[Any]:
    return (view.time_ms, 1, 0, *motion_fields(view.autopilot.pilot.motion))
