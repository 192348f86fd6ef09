"""Setpoints: what is asked to be flown, and how a firmware takes it.

Knows fields of messages as values by name, and no pilot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from simulator.firmware.vocabulary import NAN3, Quaternion, ReadParameter, Say, Triple


@dataclass(frozen=True, slots=True)
class AttitudeSetpoint:
    """What the firmware makes of a SET_ATTITUDE_TARGET. None: keep what was demanded before.

    `climb_mps` not None: the autopilot's own vertical loop makes the thrust. `event` happens when
    the setpoint is taken, for what a firmware does about values that it should have refused.
    """

    attitude: Quaternion | None
    rates_frd_radps: Triple | None
    thrust: float  # 0 .. 1
    climb_mps: float | None = None
    event: str = ""


@dataclass(frozen=True, slots=True)
class MotionSetpoint:
    """Position, velocity, acceleration (NED, SI), yaw (rad), yaw rate; NaN where not demanded."""

    position_ned_m: Triple = NAN3
    velocity_ned_mps: Triple = NAN3
    acceleration_ned_mps2: Triple = NAN3
    yaw_rad: float = math.nan
    yaw_rate_radps: float = math.nan
    faces_way: bool = False  # with neither yaw nor its rate demanded, the course is the way wanted
    turn_radps: float = math.inf  # no faster


@dataclass(frozen=True, slots=True)
class SetpointRules:
    """How a firmware reads setpoint messages, and when it obeys them."""

    attitude: Callable[[Mapping[str, Any], ReadParameter], AttitudeSetpoint | MotionSetpoint | None]
    motion: Callable[[Mapping[str, Any]], MotionSetpoint | None]
    # a SET_POSITION_TARGET in another local frame, by position and attitude, in MAV_FRAME 1
    in_local_frame: Callable[[Mapping[str, Any], Triple, Quaternion], Mapping[str, Any]]
    home_mirrored: bool  # heights above home take home as high as it is low, about the origin
    global_frames: frozenset[int]  # MAV_FRAME that SET_POSITION_TARGET_GLOBAL_INT may come in
    # what is said about the named setpoint message in an unknown MAV_FRAME, or demanding nothing
    complaint: Callable[[str, int | None], Say | None]
    mode_needs_stream: bool  # to be healthy in
    as_automatic: bool  # they are flown at the speeds and turns of automatic flight
    outlive_modes: bool  # else obeyed only in their mode, forgotten on entering it
    decide_flight: bool  # any thrust is flight; the land detector rests meanwhile
    spool_s: float  # from arming until a setpoint's thrust acts
    reaction_s: float  # from the stream's time-out until it counts as lost
