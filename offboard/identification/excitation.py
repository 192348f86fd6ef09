"""Small steps added to what the law commands, so that the vehicle shows how it answers.

Tilt steps come as + - + of lengths 1 : 2 : 1, which end where they began, first north, then east;
thrust and course alike. A pure function of the time since the beginning: the same flight, the same
steps.
"""

from __future__ import annotations

import math

from offboard.model.command import Command
from offboard.model.frames import wrap_pi

# (begins, length of the first of the four parts), seconds
NORTH_S = ((0.0, 0.3), (2.4, 0.2))
EAST_S = ((1.2, 0.3), (3.2, 0.2))
THRUST_S = ((0.2, 0.3), (2.2, 0.3))
COURSE_S = ((0.0, 1.0),)
LENGTH_S = 4.0


def excited(command: Command, time_s: float, tilt_rad: float, thrust_share: float) -> Command:
    """`command` with the steps of `time_s` since the beginning: tilt and course by `tilt_rad` and
    twice that, thrust by a share of itself."""
    north, east, _ = command.thrust_direction_ned
    north += math.sin(tilt_rad) * _there_and_back(time_s, NORTH_S)
    east += math.sin(tilt_rad) * _there_and_back(time_s, EAST_S)
    lateral = math.hypot(north, east)
    if lateral >= 0.9:
        return command
    thrust = command.thrust_mps2 * (1.0 + thrust_share * _there_and_back(time_s, THRUST_S))
    course = command.course_rad + 2.0 * tilt_rad * _there_and_back(time_s, COURSE_S)
    return Command(
        thrust, (north, east, math.sqrt(1.0 - lateral * lateral)), float(wrap_pi(course))
    )


def _there_and_back(time_s: float, begins: tuple[tuple[float, float], ...]) -> float:
    """+1, -1, -1, +1 in parts of the given length from each beginning; else 0."""
    for begin_s, part_s in begins:
        part = math.floor((time_s - begin_s) / part_s + 1e-6)
        if 0 <= part < 4:
            return 1.0 if part in (0, 3) else -1.0
    return 0.0
