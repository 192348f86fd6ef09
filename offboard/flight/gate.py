"""The gate: the last check of a setpoint before it is sent. PX4 flies any setpoint it receives.

Independent of the control laws and of their limits.
"""

from __future__ import annotations

import math

from offboard.model.command import Command, PositionCommand
from offboard.model.vehicle import Vehicle

LEVEL = (0.0, 0.0, 1.0)
_LENGTH_TOLERANCE = 0.01


def usable(command: Command | PositionCommand) -> bool:
    """Whether all values are finite and the thrust direction is a unit vector."""
    if isinstance(command, PositionCommand):
        vectors = (
            command.position_ned_m,
            command.velocity_ned_mps,
            command.acceleration_ned_mps2,
            (command.course_rad, command.course_rate_radps),
        )
        return all(math.isfinite(value) for vector in vectors for value in vector)
    values = (command.thrust_mps2, *command.thrust_direction_ned, command.course_rad)
    if not all(math.isfinite(value) for value in values):
        return False
    return abs(math.hypot(*command.thrust_direction_ned) - 1.0) <= _LENGTH_TOLERANCE


def clamp(command: Command, vehicle: Vehicle) -> Command:
    """`command` limited to the vehicle's thrust and tilt.

    A direction tilted by more than `tilt_max_rad` is turned back to that tilt in its own vertical
    plane.
    """
    thrust = min(max(command.thrust_mps2, 0.0), vehicle.thrust_max_mps2)
    north, east, down = command.thrust_direction_ned
    lateral = math.hypot(north, east)
    if math.atan2(lateral, down) > vehicle.tilt_max_rad and lateral > 0.0:
        scale = math.sin(vehicle.tilt_max_rad) / lateral
        north, east, down = scale * north, scale * east, math.cos(vehicle.tilt_max_rad)
    return Command(thrust, (north, east, down), command.course_rad)
