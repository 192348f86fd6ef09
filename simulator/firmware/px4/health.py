"""Start, pre-arm checks and battery levels of PX4."""

from __future__ import annotations

from simulator.firmware.base import HealthRules, Sensors
from simulator.firmware.values import ReadParameter
from simulator.vehicle.battery import BatteryState

_BATTERY_THRESHOLDS = ("BAT_LOW_THR", "BAT_CRIT_THR", "BAT_EMERGEN_THR")


def battery_level(battery: BatteryState, parameter: ReadParameter) -> int:
    """By the remaining share."""
    return sum(battery.remaining < parameter(name) for name in _BATTERY_THRESHOLDS)


_GATE_MPS = 5.0 * 0.3  # EKF2_GPS_V_GATE standard deviations of EKF2_GPS_V_NOISE


def velocity_ratio(error_mps: float) -> float:
    """Squared, as PX4 reports it."""
    return (error_mps / _GATE_MPS) ** 2


def velocity_ratio_most(_: ReadParameter) -> float:
    """EKF2's limit before take-off."""
    return 0.5


HEALTH = HealthRules(
    boot={},
    # gyro, accelerometer, magnetometer, absolute pressure, GPS; battery, AHRS; the health bits
    # include the geofence, or MAVProxy reports a breach
    sensors=Sensors(0x0300402F, 0x0301402F, 0x0330C83F, first_fix_s=3.0),
    passes_after_s=4.0,
    passes_without_position_after_s=4.0,
    fails_where_unarmable=True,
    position_without_fix_s=5.0,  # EKF2_NOAID_TOUT
    velocity_ratio=velocity_ratio,
    velocity_ratio_most=velocity_ratio_most,
    battery_level=battery_level,
    battery_events=("battery low", "battery critical", "battery emergency"),
)
