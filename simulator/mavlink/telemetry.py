"""Messages that a vehicle sends, by name, with the function that builds each.

Builders for every firmware are in `simulator.mavlink.motion_messages` and
`simulator.mavlink.status_messages`, those for one firmware in its `messages.py`. A public function
there builds the message of its name; nothing else has to list it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

from simulator.firmware.base import Firmware
from simulator.mavlink import motion_messages, status_messages
from simulator.mavlink.codec import id_of
from simulator.mavlink.view import View

Builder = Callable[[View], Sequence[Any]]

ON_POSITION_GRID = frozenset(
    {"LOCAL_POSITION_NED", "ODOMETRY", "GLOBAL_POSITION_INT", "HIL_STATE_QUATERNION"}
)
LEAST_INTERVAL_US = {"GPS_RAW_INT": 125_000.0}  # a receiver gives eight fixes a second


def builders_in(module: ModuleType) -> dict[str, Builder]:
    """The public functions of a module, by the message that each builds.

    Raises:
        ValueError: a public function is not called like a MAVLink message.
    """
    found: dict[str, Builder] = {
        name.upper(): function
        for name, function in vars(module).items()
        if inspect.isfunction(function)
        and function.__module__ == module.__name__
        and not name.startswith("_")
    }
    unknown = sorted(name for name in found if id_of(name) is None)
    if unknown:
        raise ValueError(f"{module.__name__}: not a MAVLink message: {', '.join(unknown)}")
    return found


BUILDERS = {**builders_in(motion_messages), **builders_in(status_messages)}


def builders(firmware: Firmware) -> dict[str, Builder]:
    """All messages of this firmware, with their builders.

    Raises:
        ValueError: a stream of the firmware has no builder, or a message that it never sends has.
    """
    streams = firmware.streams
    known = {**BUILDERS, **streams.messages}
    named = {*streams.companion_rates_hz, *streams.ground_rates_hz, *streams.withheld_until}
    missing = sorted(named.union(streams.fixed, *streams.groups.values()).difference(known))
    if missing:
        raise ValueError(f"{firmware.name} streams: no builder for {', '.join(missing)}")
    unsent = sorted(name for name in known if id_of(name) in streams.never_sent)
    if unsent:
        raise ValueError(f"{firmware.name} streams: remove from never_sent: {', '.join(unsent)}")
    return known
