"""Small steps of tilt, thrust and heading that are added to the command, to show the response.

Tilt steps are + - - + in four equal parts, so that the vehicle ends where it began, first north,
then east; thrust and heading alike. The steps depend on nothing but the time since they began.
"""

from __future__ import annotations

import math

from offboard.model.command import Command
from offboard.model.frames import wrap_pi

# (start, length of one of the four parts), s
NORTH_S = ((0.0, 0.3), (2.4, 0.2))
EAST_S = ((1.2, 0.3), (3.2, 0.2))
THRUST_S = ((0.2, 0.3), (2.2, 0.3))
HEADING_S = ((0.0, 1.0),)
LENGTH_S = 4.0
TILT_RAD = math.radians(2.0)
THRUST_SHARE = 0.05


def excited(command: Command, time_s: float) -> Command:
    """`command` with the steps at `time_s` since their beginning: tilt by TILT_RAD, heading by
    twice that, thrust by THRUST_SHARE of itself. A command tilted by more than 64 degrees is
    returned as it is."""
    north, east, _ = command.thrust_direction_ned
    north += math.sin(TILT_RAD) * _step_sign(time_s, NORTH_S)
    east += math.sin(TILT_RAD) * _step_sign(time_s, EAST_S)
    lateral = math.hypot(north, east)
    if lateral >= 0.9:
        return command
    thrust = command.thrust_mps2 * (1.0 + THRUST_SHARE * _step_sign(time_s, THRUST_S))
    heading = command.heading_rad + 2.0 * TILT_RAD * _step_sign(time_s, HEADING_S)
    return Command(
        thrust, (north, east, math.sqrt(1.0 - lateral * lateral)), float(wrap_pi(heading))
    )


def _step_sign(time_s: float, steps: tuple[tuple[float, float], ...]) -> float:
    """+1, -1, -1, +1 in the four parts of each step, else 0."""
    for begin_s, part_s in steps:
        part = math.floor((time_s - begin_s) / part_s + 1e-6)
        if 0 <= part < 4:
            return 1.0 if part in (0, 3) else -1.0
    return 0.0
