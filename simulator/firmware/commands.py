"""Commands: what they ask for, and how a firmware answers them.

What they do is `simulator.mavlink.commands`'.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from simulator.firmware.vocabulary import Result, Say


@dataclass(frozen=True, slots=True)
class ModeRequest:
    """What a mode command asks for: a mode's name, or the result to refuse it with."""

    mode: str | None
    refusal: Result = Result.DENIED
    say: Say | None = None


@dataclass(frozen=True, slots=True)
class ArmWish:
    """What an arm or disarm command asks for: an event, or what it is refused with."""

    event: str = ""
    refusal: Result | None = None  # None: no answer
    say: Say | None = None


@dataclass(frozen=True, slots=True)
class CommandRules:
    """How a firmware reads commands and what it answers."""

    mode: Callable[[tuple[float, ...]], ModeRequest]  # params of MAV_CMD_DO_SET_MODE
    mode_acked_twice: bool  # the receiver acks a mode command before the commander does
    set_mode: Callable[[int, int], ModeRequest]  # SET_MODE: base_mode, custom_mode
    set_mode_acked_as: int | None  # what the acknowledgement of SET_MODE names; None: there is none
    arm_wish: Callable[[float], ArmWish]  # param1 of MAV_CMD_COMPONENT_ARM_DISARM
    force_codes: Mapping[str, float]  # its param2: arm, disarm
    takeoff_above_home: bool  # MAV_CMD_NAV_TAKEOFF: else above mean sea level
    reposition_mode: str  # in which it goes where MAV_CMD_DO_REPOSITION says
    repositions_strictly: bool  # its frame must be told and its place be one; yaw is ignored
    speed_refusal: Result  # of MAV_CMD_DO_CHANGE_SPEED to no speed
    # MAV_CMD that are not carried out: their answers, None for silence; the rest is UNSUPPORTED
    answers: Mapping[int, Result | None]
