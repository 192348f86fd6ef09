"""Builders of the messages that every firmware sends.

A public function builds the message of its name: it returns the fields in the order of the XML.
The builders of one firmware only are in `simulator.firmware.px4_messages` and
`simulator.firmware.ardupilot_messages`. Knows no links, rates or sequence numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from simulator.autopilot.position_loop import level
from simulator.mavlink.view import View, centi, fit, heading_cdeg, pressure_hpa

# -- motion ------------------------------------------------------------------------------------


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
        math.hypot(north, east, down) if autopilot.firmware.estimates_airspeed else 0.0,
        math.hypot(north, east),
        heading_cdeg(nav.yaw_rad) // 100,
        fit(autopilot.position_controller.demand.thrust * 100, 16, signed=False),
        view.altitude_mm(nav.position_ned_m[2]) / 1e3,
        -down,
    )


def gps_raw_int(view: View) -> Sequence[Any]:
    """The reported accuracies are those of PX4's SIH, which are larger than its errors."""
    if not view.autopilot.commander.has_fix:
        return (view.time_us, 1, 0, 0, 0, 65535, 65535, 65535, 65535, 0, *(0,) * 6)
    north, east, down, v_north, v_east = view.autopilot.plant.fix()
    course = heading_cdeg(math.atan2(v_east, v_north))
    speed = fit(math.hypot(v_north, v_east) * 100, 16, signed=False)
    height = view.altitude_mm(down)
    latitude, longitude = view.geodetic(north, east)
    return (
        view.time_us, 3, latitude, longitude, height, 70, 110, speed, course, 10, height,
        900, 1780, 400, 0, 0,
    )  # fmt: skip


def attitude_target(view: View) -> Sequence[Any]:
    demand = view.autopilot.position_controller.demand
    rates = demand.rates_frd_radps or (0.0, 0.0, 0.0)
    return (
        view.time_ms,
        0,
        demand.attitude or (1.0, 0.0, 0.0, 0.0),
        *rates,
        view.autopilot.position_controller.thrust_demanded,
    )


def position_target_local_ned(view: View) -> Sequence[Any]:
    """The motion that is flown, in MAV_FRAME 1; NaN where nothing is demanded."""
    motion = view.autopilot.position_controller.motion
    return (
        view.time_ms, 1, 0, *motion.position_ned_m, *motion.velocity_ned_mps,
        *motion.acceleration_ned_mps2, motion.yaw_rad, motion.yaw_rate_radps,
    )  # fmt: skip


def position_target_global_int(view: View) -> Sequence[Any]:
    """The place that is flown to, AMSL; without one, the position bits of type_mask are set."""
    place = view.autopilot.position_controller.motion.position_ned_m
    known = all(map(math.isfinite, place))
    north, east, down = place if known else (0.0, 0.0, 0.0)
    frame, mask = 0, 0xFDF8 if known else 0xFDFF
    height_m = view.altitude_mm(down) * 1e-3
    return (view.time_ms, frame, mask, *view.geodetic(north, east), height_m, *(0.0,) * 8)


# -- state, clock, home, mission ---------------------------------------------------------------


def sys_status(view: View) -> Sequence[Any]:
    battery = view.autopilot.plant.battery
    present, enabled, health = view.sensor_bits
    return (
        present, enabled, health, 80,
        fit(battery.voltage_v * 1e3, 16, signed=False),
        fit(battery.current_a * 100, 16),
        fit(battery.remaining * 100, 8),
        0, 0, 0, 0, 0, 0, 0, 0, 1,
    )  # fmt: skip


def battery_status(view: View) -> Sequence[Any]:
    battery = view.autopilot.plant.battery
    voltage = fit(battery.voltage_v * 1e3, 16, signed=False)
    return (
        0, 1, 1, 32767, (voltage, *(65535,) * 9), fit(battery.current_a * 100, 16),
        fit(battery.used_mah, 32), -1, fit(battery.remaining * 100, 8), 0, 1, (0, 0, 0, 0), 0, 0,
    )  # fmt: skip


def extended_sys_state(view: View) -> Sequence[Any]:
    return (0, view.landed_state)


def system_time(view: View) -> Sequence[Any]:
    return (view.epoch_us + view.time_us, view.time_ms)


def timesync(view: View) -> Sequence[Any]:
    return (0, view.time_us * 1000)


def home_position(view: View) -> Sequence[Any]:
    north, east, down = view.autopilot.guidance.home_ned_m
    return (
        *view.geodetic(north, east),
        view.altitude_mm(down),
        north,
        east,
        down,
        level(view.autopilot.guidance.home_yaw_rad),
        0.0,
        0.0,
        0.0,
        view.time_us,
    )


def gps_global_origin(view: View) -> Sequence[Any]:
    return (*view.geodetic(0.0, 0.0), view.altitude_mm(0.0), view.time_us)


def mission_current(view: View) -> Sequence[Any]:
    """Current item, and number of items (65535 without a mission); PX4 leaves the rest at 0."""
    mission = view.autopilot.mission
    return (mission.current, len(mission.items) or 65535, 0, 0)


def mission_item_reached(view: View) -> Sequence[Any]:
    return (max(0, view.autopilot.mission.reached),)


def autopilot_version(view: View) -> Sequence[Any]:
    firmware = view.autopilot.firmware
    return (
        firmware.capabilities, firmware.version, 0, 0, 0,
        (0,) * 8, (0,) * 8, (0,) * 8, 0, 0, view.system, (0,) * 18,
    )  # fmt: skip
