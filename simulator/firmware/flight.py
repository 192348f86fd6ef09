"""Automatic flight: gains and limits of the position loop, landing, the way home.

Who flies so is `simulator.autopilot.pilot` and `simulator.autopilot.navigator`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from simulator.firmware.vocabulary import ReadParameter, Triple


class Heads(Enum):
    """Course of an automatic flight."""

    ALONG = "the way that it flies"
    AS_HOME = "the course at home"


@dataclass(frozen=True, slots=True)
class PositionGains:
    """Cascaded position loop: P on position, PID on velocity (acceleration out), and limits."""

    position_xy_ps: float
    position_z_ps: float
    velocity_xy: Triple  # P 1/s, I 1/s^2, D -
    velocity_z: Triple
    speed_xy_mps: float
    speed_up_mps: float
    speed_down_mps: float
    follows_down_mps: float  # after a point that keeps its own limits
    tilt_max_rad: float
    thrust_max: float
    derivative_cutoff_hz: float
    turn_radps: float  # of automatic flight, no faster
    speeding_mps2: float  # the same, across the ground
    braking_mps2: float  # the same, on the way to a place
    facing_mps: float  # wanted across the ground, from which on it faces its way


@dataclass(frozen=True, slots=True)
class PathLimits:
    """Within which a way to a goal is drawn, where a firmware draws one
    (`simulator.autopilot.trajectory`).

    A takeoff goes at `lift` as long as it is lower than that above home. A corner is flown with a
    share of the acceleration across; a point that runs further ahead than `behind_max_m` waits.
    """

    jerk_mps3: float
    across_mps2: float
    up_mps2: float
    down_mps2: float
    speed_across_mps: float
    speed_up_mps: float
    speed_down_mps: float
    lift_mps: float
    lift_mps2: float
    lift_below_m: float
    corner_share: float
    accepted_m: float  # from a goal, across and in height
    accepted_height_m: float
    behind_max_m: float


@dataclass(frozen=True, slots=True)
class Landing:
    """How the land detector finds out. Shares are between the least and the hover thrust."""

    low_thrust_share: float  # no more than this can be a landing
    idle_thrust_share: float  # more than this is a takeoff
    sinking_mps: float  # told to go down at this is told to land
    speed_down_mps: float  # estimated, of a vehicle that stands
    speed_across_mps: float
    rate_radps: float  # roll and pitch together
    place_below_is_descent: bool


@dataclass(frozen=True, slots=True)
class Handling:
    """How a firmware flies by sticks; `feigned`: pulse widths, us, of roll, pitch, throttle, yaw
    and further channels."""

    feigned: tuple[int, ...]
    climb_mps: float  # at the ends of the throttle's way, up and down
    turn_radps: float
    speed_mps: float  # that no stick exceeds
    acceleration_mps2: float  # of a stick at its end
    braking_mps2: float  # once no stick asks for anything
    braking_after_s: float


@dataclass(frozen=True, slots=True)
class FlightRules:
    """How a firmware flies by itself."""

    gains: Callable[[ReadParameter], PositionGains]
    path_limits: Callable[[ReadParameter], PathLimits] | None  # None: it draws no ways
    integrates_on_ramp: bool  # of a takeoff, as long as the ground still carries it
    landing: Landing
    descend_speed_mps: float  # where sticks are missed
    handling: Handling | None  # by sticks; None: it has none
    return_height_m: Callable[[float, ReadParameter], float]  # above home, by the distance to it
    # where a return heads at this distance: home, home's own course, or None: as it did
    return_heads: Callable[[float, ReadParameter], Heads | None]
