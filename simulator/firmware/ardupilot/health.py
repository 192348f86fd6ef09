"""Start, pre-arm checks and battery levels of ArduCopter."""

from __future__ import annotations

from simulator.firmware.base import HealthRules, Sensors
from simulator.firmware.values import ReadParameter
from simulator.vehicle.battery import BatteryState

# Boot events, seconds after boot
_BOOT = {
    "initialised": 2.47,
    "aligning": 5.40,
    "attitude": 5.90,
    "origin": 20.02,
    "gyros": 24.0,
    "reminder": 30.45,
    "position": 41.61,
}


def battery_level(battery: BatteryState, parameter: ReadParameter) -> int:
    """By voltage or by remaining charge of BATT_CAPACITY; a threshold of 0 disables the check."""

    def below(kind: str) -> bool:
        left_mah = battery.remaining * parameter("BATT_CAPACITY")
        by_voltage = battery.voltage_v < parameter(f"BATT_{kind}_VOLT")
        return by_voltage or left_mah < parameter(f"BATT_{kind}_MAH")

    return 2 if below("CRT") else int(below("LOW"))


_GATE_MPS = 5.0 * 0.3  # EK3_VEL_I_GATE standard deviations of EK3_VELNE_M_NSE


def velocity_ratio(error_mps: float) -> float:
    """The ratio as EKF_STATUS_REPORT has it: the square root of the squared test ratio."""
    return error_mps / _GATE_MPS


def velocity_ratio_most(parameter: ReadParameter) -> float:
    """As the failsafe in flight."""
    return parameter("FS_EKF_THRESH")


HEALTH = HealthRules(
    boot=_BOOT,
    sensors=Sensors(0x5371FC2F, 0x5361FC2F, 0x4771FC2F, first_fix_s=10.2),
    passes_after_s=42.5,
    passes_without_position_after_s=24.0,
    fails_where_unarmable=False,
    position_without_fix_s=8.0,
    velocity_ratio=velocity_ratio,
    velocity_ratio_most=velocity_ratio_most,
    battery_level=battery_level,
    battery_events=("battery low", "battery critical"),
)
