"""Requests over MAVLink: what a ground station may ask our component for, and the answer.

MAV_CMD_MISSION_START (300) starts the reference, MAV_CMD_DO_PAUSE_CONTINUE (193) pauses and
continues it, MAV_CMD_DO_SET_MODE (176), with any parameters, hands the vehicle back.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum, IntEnum

from offboard.flight.phases import MOVING, TRACKING, Phase

START, PAUSE_CONTINUE, SET_MODE = 300, 193, 176  # MAV_CMD
BEGINNING = (Phase.STREAM, Phase.ENGAGE, Phase.ARM, Phase.TAKEOFF)
ENDING = (Phase.HAND_BACK, Phase.HOLD)


class Request(Enum):
    """What is to be done at the next tick."""

    NONE = "nothing"
    START = "start"
    PAUSE = "pause"
    CONTINUE = "continue"
    HAND_BACK = "hand back"


class Result(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3


@dataclass(frozen=True, slots=True)
class Circumstances:
    """What the answer depends on. `may_arm`: the service runs with --arms. `can_take_over`: the
    vehicle flies in the mode of setpoints, and nothing prevents that we fly it."""

    phase: Phase
    armed: bool
    may_arm: bool
    ready: bool
    can_take_over: bool


Answer = tuple[Result, Request]
NOTHING_TO_DO: Answer = (Result.ACCEPTED, Request.NONE)
NOT_NOW: Answer = (Result.TEMPORARILY_REJECTED, Request.NONE)
DENIED: Answer = (Result.DENIED, Request.NONE)


def answer(command: int, parameters: tuple[float, ...], now: Circumstances) -> Answer:
    """The result to acknowledge `command` with, and what is to be done."""
    answered = _ANSWERS.get(command)
    return answered(parameters, now) if answered else (Result.UNSUPPORTED, Request.NONE)


def _start(_: tuple[float, ...], now: Circumstances) -> Answer:
    if now.phase in TRACKING:
        return Result.ACCEPTED, Request.START
    if now.phase in BEGINNING:
        return NOTHING_TO_DO
    if now.phase is not Phase.STANDBY:
        return NOT_NOW
    if now.armed:
        return (Result.ACCEPTED, Request.START) if now.can_take_over else NOT_NOW
    if not now.may_arm:
        return DENIED
    return (Result.ACCEPTED, Request.START) if now.ready else NOT_NOW


def _pause_or_continue(parameters: tuple[float, ...], now: Circumstances) -> Answer:
    wanted = {0.0: Request.PAUSE, 1.0: Request.CONTINUE}.get(parameters[0])
    if wanted is None:
        return DENIED
    if now.phase in MOVING:
        return (Result.ACCEPTED, wanted) if wanted is Request.PAUSE else NOTHING_TO_DO
    if now.phase is Phase.PAUSE:
        return (Result.ACCEPTED, wanted) if wanted is Request.CONTINUE else NOTHING_TO_DO
    return NOTHING_TO_DO if now.phase is Phase.HOVER else NOT_NOW


def _hand_back(_: tuple[float, ...], now: Circumstances) -> Answer:
    if now.phase in TRACKING or now.phase in BEGINNING:
        return Result.ACCEPTED, Request.HAND_BACK
    return NOTHING_TO_DO if now.phase in ENDING else DENIED


_ANSWERS: Mapping[int, Callable[[tuple[float, ...], Circumstances], Answer]] = {
    START: _start,
    PAUSE_CONTINUE: _pause_or_continue,
    SET_MODE: _hand_back,
}
