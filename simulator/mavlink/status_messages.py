"""Builders of messages about state, clock, home and mission.

One function per message, named like it, returns its fields in the order of the XML. Knows no links,
rates or sequence numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from simulator.mavlink.fields import fit
from simulator.mavlink.view import View

MAV_TYPE_QUADROTOR = 2


def heartbeat(view: View) -> Sequence[Any]:
    autopilot = view.autopilot
    base_mode, status = autopilot.commander.heartbeat
    return (
        MAV_TYPE_QUADROTOR,
        autopilot.firmware.mav_autopilot,
        base_mode,
        autopilot.commander.mode.custom_mode,
        status,
        3,
    )


def sys_status(view: View) -> Sequence[Any]:
    autopilot = view.autopilot
    battery = autopilot.state.truth.battery
    present, enabled, health = view.sensor_bits
    return (
        present, enabled, health, 80,
        fit(battery.voltage_v * 1e3, 16, signed=False),
        fit(battery.current_a * 100, 16),
        fit(battery.remaining * 100, 8),
        0, 0, 0, 0, 0, 0, 0, 0, 1,
    )  # fmt: skip


def battery_status(view: View) -> Sequence[Any]:
    battery = view.autopilot.state.truth.battery
    voltage = fit(battery.voltage_v * 1e3, 16, signed=False)
    return (
        0, 1, 1, 32767, (voltage, *(65535,) * 9), fit(battery.current_a * 100, 16), 0, -1,
        fit(battery.remaining * 100, 8), 0, 1, (0, 0, 0, 0), 0, 0,
    )  # fmt: skip


def extended_sys_state(view: View) -> Sequence[Any]:
    return (0, view.landed_state)


def system_time(view: View) -> Sequence[Any]:
    return (view.epoch_us + view.time_us, view.time_ms)


def timesync(view: View) -> Sequence[Any]:
    return (0, view.time_us * 1000)


def home_position(view: View) -> Sequence[Any]:
    north, east, down = view.autopilot.guidance.home_ned_m
    yaw_rad = view.autopilot.guidance.home_yaw_rad
    return (
        *view.geodetic(north, east),
        view.altitude_mm(down),
        north,
        east,
        down,
        (math.cos(0.5 * yaw_rad), 0.0, 0.0, math.sin(0.5 * yaw_rad)),
        0.0,
        0.0,
        0.0,
        view.time_us,
    )


def gps_global_origin(view: View) -> Sequence[Any]:
    return (*view.geodetic(0.0, 0.0), view.altitude_mm(0.0), view.time_us)


def mission_current(view: View) -> Sequence[Any]:
    """Current item and number of items, 65535 without a mission; the other fields are 0 in PX4."""
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
