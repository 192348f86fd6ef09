"""The gate: the last check of a setpoint before it is sent. PX4 flies any setpoint it receives.

Independent of the control laws and of their limits. Every setpoint passes `admit`, which is called
in one place (`outbox`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntFlag
from typing import overload

from offboard.mavlink.encode import FLOAT32_MAX
from offboard.model.command import Command, PositionCommand
from offboard.model.vehicle import Vehicle

LEVEL = (0.0, 0.0, 1.0)
_LENGTH_TOLERANCE = 0.01


class Refusal(IntFlag):
    """Why a setpoint was not sent, as the log has it."""

    LATE = 1  # decided after its deadline
    STALE = 2  # the telemetry that it was made for is too old
    NOT_OURS = 4  # the vehicle does not, or may not, follow us
    UNUSABLE = 8  # not finite, or beyond the numbers of the wire


class Refused(Exception):
    """A setpoint that must not leave; the message is the reason, `why` its number."""

    def __init__(self, why: Refusal, reason: str) -> None:
        super().__init__(reason)
        self.why = why


@dataclass(frozen=True, slots=True)
class Clearance:
    """What `admit` must know of the moment.

    Args:
        ours: the vehicle is ours to command (`Authority.permits_setpoint`).
        on_ground: it certainly stands on the ground (`GroundContact.certain`).
        age_s: age of the telemetry that the setpoint was computed from, beyond the known delay of
            the link; 0 for a setpoint that needs none.
        age_limit_s: the greatest age that may leave.
        late_s: time by which the decision missed its deadline; 0 if it did not.
    """

    ours: bool
    on_ground: bool
    age_s: float = 0.0
    age_limit_s: float = math.inf
    late_s: float = 0.0


@overload
def admit(command: Command, vehicle: Vehicle, clearance: Clearance) -> Command: ...
@overload
def admit(command: PositionCommand, vehicle: Vehicle, clearance: Clearance) -> PositionCommand: ...
def admit(
    command: Command | PositionCommand, vehicle: Vehicle, clearance: Clearance
) -> Command | PositionCommand:
    """The setpoint that may leave: `command` within the vehicle's limits.

    Raises Refused if the vehicle is not ours, the telemetry was too old, the decision too late, or
    a value cannot be sent.
    """
    if not clearance.ours:
        raise Refused(Refusal.NOT_OURS, "the vehicle is not ours")
    if not clearance.age_s <= clearance.age_limit_s:
        raise Refused(Refusal.STALE, f"decided on telemetry that is {clearance.age_s:.2f} s old")
    if not clearance.late_s <= 0.0:
        raise Refused(Refusal.LATE, f"decided {clearance.late_s:.2f} s too late")
    if not usable(command):
        raise Refused(Refusal.UNUSABLE, f"unusable {command}")
    if isinstance(command, PositionCommand):
        return command
    return clamp(command, vehicle, on_ground=clearance.on_ground)


def usable(command: Command | PositionCommand) -> bool:
    """Whether all values can be sent, as float32, and the thrust direction is a unit vector."""
    if isinstance(command, PositionCommand):
        vectors = (
            command.position_ned_m,
            command.velocity_ned_mps,
            command.acceleration_ned_mps2,
            (command.course_rad, command.course_rate_radps),
        )
        return all(abs(value) <= FLOAT32_MAX for vector in vectors for value in vector)
    values = (command.thrust_mps2, *command.thrust_direction_ned, command.course_rad)
    if not all(abs(value) <= FLOAT32_MAX for value in values):
        return False
    return abs(math.hypot(*command.thrust_direction_ned) - 1.0) <= _LENGTH_TOLERANCE


def clamp(command: Command, vehicle: Vehicle, *, on_ground: bool = False) -> Command:
    """`command` limited to the vehicle's thrust and tilt.

    A direction tilted by more than `tilt_max_rad` is turned back to that tilt in its own vertical
    plane. Unless the vehicle certainly stands on the ground, thrust is at least a third of hover.
    """
    least_mps2 = 0.0 if on_ground else vehicle.thrust_min_mps2
    thrust = min(max(command.thrust_mps2, least_mps2), vehicle.thrust_max_mps2)
    north, east, down = command.thrust_direction_ned
    lateral = math.hypot(north, east)
    if math.atan2(lateral, down) > vehicle.tilt_max_rad:
        # a direction that is exactly vertical is tilted to the north (atan2 of zeros)
        towards_rad, scale = math.atan2(east, north), math.sin(vehicle.tilt_max_rad)
        north, east = scale * math.cos(towards_rad), scale * math.sin(towards_rad)
        down = math.cos(vehicle.tilt_max_rad)
    return Command(thrust, (north, east, down), command.course_rad)
