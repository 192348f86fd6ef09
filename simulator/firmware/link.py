"""Manners on a link.

What is said there is others'.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from simulator.firmware.vocabulary import ReadParameter


@dataclass(frozen=True, slots=True)
class LinkRules:
    """Whom a firmware hears, and how it speaks."""

    is_ground_station: Callable[[int, int, ReadParameter], bool]  # MAV_TYPE, system of a heartbeat
    ground_station_stays_s: float  # after its last heartbeat
    obeys_system: Callable[[int, int, ReadParameter], bool]  # sender, own
    target_component_checked: bool
    text_suffix: str
    text_to_ground_stations_only: bool
    parameters_bytewise: bool  # INT32 lies in the float's bytes, not as its value
    parameters_hashed: bool  # a list begins with what all values come to
    parameters_numbered: bool  # PARAM_VALUE; else 65535 unless the list was asked for
