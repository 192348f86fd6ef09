"""How PX4 reads commands and acknowledges them."""

from __future__ import annotations

import math

from simulator.firmware.base import CommandRules
from simulator.firmware.values import ArmRequest, ModeRequest, Result, critical

# PX4_CUSTOM_MAIN_MODE, PX4_CUSTOM_SUB_MODE_AUTO
_MAIN = {1: "MANUAL", 2: "ALTCTL", 3: "POSCTL", 5: "ACRO", 6: "OFFBOARD", 7: "STABILIZED"}
_AUTO_SUB = {
    2: "AUTO.TAKEOFF",
    3: "AUTO.LOITER",
    4: "AUTO.MISSION",
    5: "AUTO.RTL",
    6: "AUTO.LAND",
    8: "AUTO.FOLLOW",
    9: "AUTO.PRECLAND",
}
_CUSTOM_MODE_ENABLED = 1
_NO_AUTO_MODE = critical("Unsupported auto mode")


def command_mode(params: tuple[float, ...]) -> ModeRequest:
    """MAV_CMD_DO_SET_MODE (176): param1 base mode, param2 main mode, param3 sub mode of AUTO.

    An unknown main mode, or a base mode alone, is accepted and changes nothing.
    """
    base, main, sub = (int(p) if math.isfinite(p) else 0 for p in params[:3])
    if not base & _CUSTOM_MODE_ENABLED:
        return ModeRequest(None, Result.ACCEPTED)
    if main == 4:
        known = _AUTO_SUB.get(sub)
        text = None if known else _NO_AUTO_MODE
        return ModeRequest(known, Result.TEMPORARILY_REJECTED, text)
    return ModeRequest(_MAIN.get(main), Result.ACCEPTED)


def set_mode(base_mode: int, custom_mode: int) -> ModeRequest:
    """SET_MODE: main mode in the third byte of custom_mode, sub mode in the fourth."""
    return command_mode((base_mode, custom_mode >> 16 & 0xFF, custom_mode >> 24))


def arm_request(param: float) -> ArmRequest:
    """param1 rounded; one that is not finite disarms."""
    number = math.floor(param + 0.5) if math.isfinite(param) else 0
    if number in (0, 1):
        return ArmRequest("arm" if number else "disarm")
    text = f"Unsupported ARM_DISARM param: {param:.3f}"
    return ArmRequest(text=critical(text))


# Accepted without an effect that the simulator shows, and not acknowledged at all
_TAKEN = (80, 187, 191, 195, 197, 201, 519, 525, 528)
_UNANSWERED = (
    1, 93, 203, 204, 205, 206, 214, 220, 242, 243, 260, 310, 420, 500, 521, 530, 531, 532, 3000
)  # fmt: skip
_ANSWERS: dict[int, Result | None] = {
    **dict.fromkeys(_TAKEN, Result.ACCEPTED),
    **dict.fromkeys(_UNANSWERED),
    189: Result.CANCELLED,
    211: Result.DENIED,
    224: Result.UNSUPPORTED,  # MISSION_SET_CURRENT does it
}

COMMANDS = CommandRules(
    mode=command_mode,
    mode_acked_twice=True,
    set_mode=set_mode,
    set_mode_acked_as=176,
    arm=arm_request,
    force_codes={"arm": 21196.0, "disarm": 21196.0},
    takeoff_above_home=False,
    reposition_mode="AUTO.LOITER",
    repositions_strictly=False,
    speed_refusal=Result.ACCEPTED,
    answers=_ANSWERS,
)
