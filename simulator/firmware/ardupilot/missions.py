"""Which items of missions, fences and rally points ArduCopter takes, and how it sends them back."""

from __future__ import annotations

import math

from simulator.firmware.base import MissionRules
from simulator.firmware.values import MissionItem, Severity, StatusText, info

_UNSUPPORTED_FRAME, _UNSUPPORTED = 2, 3  # MAV_MISSION_RESULT
_SHOWN = {5: 0, 6: 3, 11: 10}  # MAV_FRAME: without INT
_PLACE_FRAMES = frozenset({0, 3, 5, 6, 10, 11})
_PLACES = frozenset({16, 17, 18, 19, 21, 22, 31, 82, 201})  # MAV_CMD of missions that have a place
_FENCE_AND_RALLY = {1: frozenset({5000, 5001, 5002, 5003, 5004}), 2: frozenset({5100})}


def _refusal(kind: int, item: MissionItem) -> tuple[int, StatusText | None] | None:
    if kind and item.command not in _FENCE_AND_RALLY[kind]:
        return _UNSUPPORTED, None
    by_place = kind or item.command in _PLACES
    if by_place and not (item.frame in _PLACE_FRAMES and math.isfinite(item.z)):
        return _UNSUPPORTED_FRAME, None
    return None


def _frame_shown(item: MissionItem, _: bool) -> int:
    """Frames without _INT; 0 for an item without a place."""
    has_place = any(item.command in known for known in (_PLACES, *_FENCE_AND_RALLY.values()))
    return _SHOWN.get(item.frame, item.frame) if has_place else 0


MISSIONS = MissionRules(
    strict=False,
    home_first=True,
    guided_items=True,
    refusal=_refusal,
    unknown_kind=3,
    texts={
        0: info("Flight plan received"),
        1: StatusText(Severity.DEBUG, "Fence Indexed OK"),
    },
    frame_shown=_frame_shown,
    without_autocontinue=frozenset({1, 2}),
    turning=frozenset(),
    reached_above_landing=False,
    keeps_speed=False,
)
