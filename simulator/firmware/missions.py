"""Items of missions, fences and rally points, and what a firmware takes of them.

How they are flown is `simulator.autopilot.mission`'s.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from simulator.firmware.vocabulary import Say


@dataclass(frozen=True, slots=True)
class MissionItem:
    """One item as it was uploaded: x and y in 1e-7 deg, z in m, of `frame` (MAV_FRAME)."""

    frame: int
    command: int  # MAV_CMD
    params: tuple[float, float, float, float]
    x: int
    y: int
    z: float


@dataclass(frozen=True, slots=True)
class MissionRules:
    """What a firmware takes of lists of items, by MAV_MISSION_TYPE, and how it shows them.

    `strict`: they go down in order alone, and are asked for in the kind that came last.
    `home_first`: the first item of a mission, there or not, is home. `guides`: an item marked
    current = 2 is where to go now. `refusal`: MAV_MISSION_RESULT and text of an item that is not
    taken. `texts` follow an upload. `frame_shown`: of an item in whole 1e-7 degrees, or in
    degrees. `stopping`: types whose items are shown without autocontinue. `turning`: commands
    (MAV_CMD) whose fourth parameter is a course.
    `tells_above`, `keeps_speed`: as in `simulator.autopilot.mission`.
    """

    strict: bool
    home_first: bool
    guides: bool
    refusal: Callable[[int, MissionItem], tuple[int, Say | None] | None]
    unknown_kind: int  # MAV_MISSION_RESULT of a MAV_MISSION_TYPE that it has not
    texts: Mapping[int, Say]
    frame_shown: Callable[[MissionItem, bool], int]
    stopping: frozenset[int]
    turning: frozenset[int]
    tells_above: bool
    keeps_speed: bool
