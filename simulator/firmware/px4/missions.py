"""Which items of missions, fences and rally points PX4 takes, and how it sends them back."""

from __future__ import annotations

import math

from simulator.firmware.base import MissionRules
from simulator.firmware.values import MissionItem, StatusText, critical

_ERROR, _UNSUPPORTED_FRAME, _UNSUPPORTED = 1, 2, 3  # MAV_MISSION_RESULT
_COMMAND_FRAME = 2  # MAV_FRAME_MISSION: no place
_IN_WHOLE_DEGREES = {0: 5, 3: 6}  # MAV_FRAME: GLOBAL, GLOBAL_RELATIVE_ALT -> the same _INT
_IN_DEGREES = {whole: frame for frame, whole in _IN_WHOLE_DEGREES.items()}
_INVALID = critical("IGN MISSION_ITEM: Invalid item")

_FENCE, _RALLY = frozenset({5000, 5001, 5002, 5003, 5004}), frozenset({5100})
_POLYGONS = frozenset({5001, 5002})
# MAV_CMD with a place, and without one
_PLACES = _FENCE | _RALLY | {16, 17, 19, 21, 22, 31, 80, 84, 85, 195, 201, 4501}
_ACTS = frozenset({
    20, 80, 93, 112, 114, 177, 178, 179, 187, 189, 196, 197, 200, 201, 203, 204, 205, 206, 211, 214,
    260, 530, 532, 534, 1000, 1001, 2000, 2001, 2003, 2500, 2501, 3000, 42600,
})  # fmt: skip


def _refusal(kind: int, item: MissionItem) -> tuple[int, StatusText | None] | None:
    by_place = item.frame in _IN_WHOLE_DEGREES or item.frame in _IN_DEGREES
    if not by_place and item.frame != _COMMAND_FRAME:
        return _UNSUPPORTED_FRAME, _INVALID
    if item.command not in (_PLACES if by_place else _ACTS):
        return _UNSUPPORTED, _INVALID
    if by_place and not math.isfinite(item.z):
        return _UNSUPPORTED_FRAME, _INVALID
    if kind == 0 and item.command in _FENCE | _RALLY:
        return _ERROR, None
    if item.command in _POLYGONS and not item.params[0] >= 2.5:  # too few corners
        return _ERROR, None
    return None


def _frame_shown(item: MissionItem, whole: bool) -> int:
    """The frame of the kind of message that is requested, whatever the upload used."""
    return (_IN_WHOLE_DEGREES if whole else _IN_DEGREES).get(item.frame, item.frame)


MISSIONS = MissionRules(
    strict=True,
    home_first=False,
    guided_items=False,
    refusal=_refusal,
    unknown_kind=4,
    texts={},
    frame_shown=_frame_shown,
    without_autocontinue=frozenset({1}),
    turning=frozenset({16, 17, 19, 21}),
    reached_above_landing=True,
    keeps_speed=True,
)
