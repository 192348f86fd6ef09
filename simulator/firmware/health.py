"""The start of a firmware, its sensors and its checks.

Whether a vehicle is fit is `simulator.autopilot.health`'s.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from simulator.firmware.vocabulary import ReadParameter
from simulator.vehicle.battery import BatteryState


@dataclass(frozen=True, slots=True)
class Sensors:
    """SYS_STATUS: MAV_SYS_STATUS_SENSOR bits once GPS has a fix, and when that is."""

    present: int
    enabled: int
    health: int
    first_fix_s: float


@dataclass(frozen=True, slots=True)
class HealthRules:
    """How a firmware starts, when its checks pass, and when it gives up."""

    boot: Mapping[str, float]  # events of the start, s of vehicle time
    sensors: Sensors
    passes_after_s: float  # boot until the pre-arm checks pass
    passes_without_position_after_s: float  # the same for modes that need none
    fails_where_unarmable: bool  # the pre-arm checks, in a mode that does not arm
    position_without_fix_s: float  # until the estimate of position is given up
    # how bad the battery is, and the events of becoming so bad, from 1 on
    battery_level: Callable[[BatteryState, ReadParameter], int]
    battery_events: tuple[str, ...]
