"""The messages the vehicle can send by itself, by name: what builds each, and how often it may.

Their contents lie in `simulator.mavlink.motion_messages` and `simulator.mavlink.status_messages`; a
firmware leaves some away and has some of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from simulator.firmware.base import Firmware
from simulator.mavlink import motion_messages, status_messages
from simulator.mavlink.view import View

Builder = Callable[[View], Sequence[Any]]

BUILDERS: dict[str, Builder] = {
    builder.__name__.upper(): builder
    for builder in (*motion_messages.MESSAGES, *status_messages.MESSAGES)
}
ON_POSITION_GRID = frozenset(
    {"LOCAL_POSITION_NED", "ODOMETRY", "GLOBAL_POSITION_INT", "HIL_STATE_QUATERNION"}
)
LEAST_INTERVAL_US = {"GPS_RAW_INT": 125_000.0}  # a receiver gives eight fixes a second


def builders(firmware: Firmware) -> dict[str, Builder]:
    """What this firmware sends, by message."""
    return {**BUILDERS, **firmware.streams.messages}
