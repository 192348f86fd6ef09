"""Data types of the setpoints: the state when a command takes effect, and the commands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PredictedVertical:
    """The vertical motion at `time_s` (vehicle time), when the thrust of a command sent now takes
    effect. Down is positive; `thrust_down_mps2` is T b_z with the thrust T per unit of mass."""

    time_s: float
    position_down_m: float
    velocity_down_mps: float
    thrust_down_mps2: float


@dataclass(frozen=True, slots=True)
class PredictedState:
    """The state predicted by the observer for `time_s`, when a command sent now takes effect. Its
    arrays cannot be changed, because the failsafe compares them with the motion that follows.

    Acceleration = g e3 - T b - c v + d, with thrust T, direction b, drag c and disturbance d.

    Attributes:
        time_s: Vehicle time, s: that of the tick plus the delay of the tilt.
        position_ned_m: (3,), in the autopilot's local NED frame.
        velocity_ned_mps: (3,).
        thrust_direction_ned: (3,), unit vector b: the body's down axis in NED, (0, 0, 1) if level.
        thrust_direction_rate_ned_ps: (3,), derivative of b, 1/s.
        heading_rad: Heading of the nose, 0 = north, clockwise, -pi .. pi.
        heading_rate_radps: Its derivative.
        thrust_mps2: Thrust per unit of mass T, after its lag.
        disturbance_ned_mps2: (3,), estimated d, caused by wind or a wrong mass or hover thrust.
        rates_frd_radps: (3,), body rates p, q, r.
        vertical: The vertical motion at the time when the thrust acts, which is earlier than that
            of the tilt. A vertical loop that used the state at `time_s` would oscillate if this
            difference were about 0.1 s or more. None: not predicted separately.
    """

    time_s: float
    position_ned_m: Array
    velocity_ned_mps: Array
    thrust_direction_ned: Array
    thrust_direction_rate_ned_ps: Array
    heading_rad: float
    heading_rate_radps: float
    thrust_mps2: float
    disturbance_ned_mps2: Array
    rates_frd_radps: Array
    vertical: PredictedVertical | None = None

    def __post_init__(self) -> None:
        for value in map(self.__getattribute__, self.__slots__):
            if isinstance(value, np.ndarray):
                value.setflags(write=False)


@dataclass(frozen=True, slots=True)
class Command:
    """An attitude setpoint, sent as SET_ATTITUDE_TARGET.

    Thrust is per unit of mass because only its ratio to the hover thrust is sent, and the mass of
    a real vehicle cannot be observed from telemetry.

    Attributes:
        thrust_mps2: Collective thrust per unit of mass, m/s^2, 0 .. `Vehicle.thrust_max_mps2`;
            in hover it equals gravity.
        thrust_direction_ned: Direction of the body's down axis (third axis, FRD) in NED, a unit
            vector; (0, 0, 1) is level. The thrust acts in the opposite direction: acceleration =
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

    def numbers(self) -> tuple[float, ...]:
        """Return all eleven numbers in this order, which is that of the MAVLink message."""
        vectors = (*self.position_ned_m, *self.velocity_ned_mps, *self.acceleration_ned_mps2)
        return (*vectors, self.heading_rad, self.heading_rate_radps)
