"""Setpoints as values: attitude and thrust, or position."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Command:
    """An attitude setpoint, sent as SET_ATTITUDE_TARGET.

    Thrust is per unit of mass because only its ratio to the hover thrust is sent, and the mass of
    a real vehicle cannot be observed from telemetry.

    Attributes:
        thrust_mps2: Collective thrust per unit of mass, m/s^2, 0 .. `Vehicle.thrust_max_mps2`;
            gravity hovers.
        thrust_direction_ned: Direction of the body's down axis (third axis, FRD) in NED, a unit
            vector; (0, 0, 1) is level. The thrust acts against it: acceleration =
            gravity - thrust_mps2 * thrust_direction_ned.
        heading_rad: Heading of the nose, rad, 0 = north, positive clockwise seen from above.

    Example:
        Command(9.81, (0.0, 0.0, 1.0), 0.0)  # level hover, nose to the north
    """

    thrust_mps2: float
    thrust_direction_ned: tuple[float, float, float]
    heading_rad: float


@dataclass(frozen=True, slots=True)
class PositionCommand:
    """A setpoint for the autopilot's own position loop, sent as SET_POSITION_TARGET_LOCAL_NED.

    Position, velocity and acceleration (feed-forward) in the autopilot's local NED frame, SI;
    heading of the nose and its rate, clockwise positive.
    """

    position_ned_m: tuple[float, float, float]
    velocity_ned_mps: tuple[float, float, float]
    acceleration_ned_mps2: tuple[float, float, float]
    heading_rad: float
    heading_rate_radps: float
