"""What is sent to an autopilot: an attitude and thrust setpoint, or a position setpoint. Values."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Command:
    """One setpoint. `thrust_mps2` is the collective thrust per unit of mass (0 .. thrust_max);
    `thrust_direction_ned` the commanded third body axis (unit, (0, 0, 1) when level);
    `course_rad` the commanded heading of the nose.

    Thrust is per unit of mass because only its ratio to the hover thrust crosses the wire, and
    the mass of a real vehicle is not observable from telemetry.
    """

    thrust_mps2: float
    thrust_direction_ned: tuple[float, float, float]
    course_rad: float


@dataclass(frozen=True, slots=True)
class PositionCommand:
    """A setpoint for the autopilot's own position loop, NED, SI; `course_rad` of the nose."""

    position_ned_m: tuple[float, float, float]
    velocity_ned_mps: tuple[float, float, float]
    acceleration_ned_mps2: tuple[float, float, float]
    course_rad: float
    course_rate_radps: float
