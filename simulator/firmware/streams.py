"""What a firmware sends without being asked, and what it sends on request.

What a message says is `simulator.mavlink.telemetry`'s.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from simulator.firmware.vocabulary import Result


@dataclass(frozen=True, slots=True)
class Streams:
    """Messages that are sent by themselves, and on request; the groups of REQUEST_DATA_STREAM.

    Texts may name the message's {id}; an empty text says nothing.
    """

    companion_rates_hz: Mapping[str, float]  # without being asked, by link
    ground_rates_hz: Mapping[str, float]
    own: Mapping[str, Callable[[Any], Sequence[Any]]]  # beside `telemetry.BUILDERS`
    unknown: frozenset[str]  # of `telemetry.BUILDERS`
    withheld_until: Mapping[str, str]  # message -> boot event before which it is not sent
    position_grid_steps: int  # the estimator's position is new at every such step
    fixed: frozenset[str]  # messages whose interval cannot be changed
    by_itself: frozenset[str]  # said when it happens, and not on request
    idle: frozenset[int]  # ids of which an interval is taken, and nothing ever said
    groups: Mapping[int, tuple[str, ...]]  # MAV_DATA_STREAM -> messages
    rate_max_hz: float
    refusal: Result  # of an interval
    refusal_text: str
    too_fast_text: str
    request_refusal: Result  # of MAV_CMD_REQUEST_MESSAGE
