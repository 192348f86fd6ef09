"""How ArduCopter reads commands and acknowledges them."""

from __future__ import annotations

import math

from simulator.firmware.ardupilot.modes import MODES
from simulator.firmware.base import CommandRules
from simulator.firmware.values import ArmRequest, ModeRequest, Result, warning

_CUSTOM_MODE_ENABLED = 1
# Modes that it has and does not enter in the simulator
_NOT_ENTERED = {
    **{
        number: f"{title} failed: init failed"
        for number, title in (
            (14, "FLIP"),
            (15, "AUTOTUNE"),
            (22, "FLOWHOLD"),
            (23, "FOLLOW"),
            (25, "SYSTEMID"),
            (28, "TURTLE"),
        )
    },
    27: "AUTO RTL failed: No return path or landing sequence found",
}
_BY_NUMBER = {mode.custom_mode: mode.name for mode in MODES.values()}


def command_mode(params: tuple[float, ...]) -> ModeRequest:
    """MAV_CMD_DO_SET_MODE (176): param1 base mode, param2 the mode's number."""
    base, number = (int(p) if math.isfinite(p) else 0 for p in params[:2])
    if not base & _CUSTOM_MODE_ENABLED:
        return ModeRequest(None, Result.DENIED)
    known = _BY_NUMBER.get(number)
    text = f"No such mode {number}"
    if number in _NOT_ENTERED:
        text = f"Mode change to {_NOT_ENTERED[number]}"
    return ModeRequest(known, Result.FAILED, None if known else warning(text))


def set_mode(base_mode: int, custom_mode: int) -> ModeRequest:
    """SET_MODE: the mode's number is custom_mode."""
    return command_mode((base_mode, custom_mode))


def arm_request(param: float) -> ArmRequest:
    """1 arms, 0 disarms, anything else is not supported."""
    if param in (0.0, 1.0):
        return ArmRequest("arm" if param else "disarm")
    return ArmRequest(refusal=Result.UNSUPPORTED)


# Accepted without an effect that the simulator shows, and failed without their devices
_TAKEN = (181, 195, 197, 203, 206, 207, 208, 2001, 5300, 42001, 42003, 42424)
_FAILED = (84, 183, 184, 189, 193, 205, 211, 218, 500, 2000, 2500)
_ANSWERS: dict[int, Result | None] = {
    **dict.fromkeys(_TAKEN, Result.ACCEPTED),
    **dict.fromkeys(_FAILED, Result.FAILED),
    532: Result.DENIED,
}

COMMANDS = CommandRules(
    mode=command_mode,
    mode_acked_twice=False,
    set_mode=set_mode,
    set_mode_acked_as=None,
    arm=arm_request,
    force_codes={"arm": 2989.0, "disarm": 21196.0},
    takeoff_above_home=True,
    reposition_mode="GUIDED",
    repositions_strictly=True,
    speed_refusal=Result.FAILED,
    answers=_ANSWERS,
)
