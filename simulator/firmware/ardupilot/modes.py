"""ArduCopter's flight modes, the command that asks for them, and what a heartbeat shows."""

from __future__ import annotations

import math

from simulator.firmware.base import (
    ArmWish,
    AttitudeSetpoint,
    Behaviour,
    Condition,
    Mode,
    ModeRequest,
    Result,
    Say,
    Severity,
)

# MAV_MODE_FLAG: 1 custom mode, 8 guided, 16 stabilise, 64 manual input. "Guided" shows whether
# the position controller runs, not the mode.
BY_POSITION, BY_HAND = 89, 81

MODES = {
    mode.name: mode
    for mode in (
        Mode("STABILIZE", "STABILIZE", 0, BY_HAND, Behaviour.LEVEL),
        Mode("ACRO", "ACRO", 1, BY_HAND, Behaviour.LEVEL),
        Mode("ALT_HOLD", "ALT_HOLD", 2, BY_HAND, Behaviour.DESCEND),
        Mode("AUTO", "AUTO", 3, BY_POSITION, Behaviour.MISSION, arms=False, needs_position=True),
        Mode("GUIDED", "GUIDED", 4, BY_POSITION, Behaviour.SETPOINT, needs_position=True),
        Mode("LOITER", "LOITER", 5, BY_POSITION, Behaviour.DESCEND, needs_position=True),
        Mode("RTL", "RTL", 6, BY_POSITION, Behaviour.RETURN, arms=False, needs_position=True),
        Mode("CIRCLE", "CIRCLE", 7, BY_POSITION, Behaviour.HOLD, arms=False, needs_position=True),
        Mode("LAND", "LAND", 9, BY_POSITION, Behaviour.LAND, arms=False),
        Mode("DRIFT", "DRIFT", 11, BY_HAND, Behaviour.DESCEND, needs_position=True),
        Mode("POSHOLD", "POSHOLD", 16, BY_POSITION, Behaviour.DESCEND, needs_position=True),
        Mode("BRAKE", "BRAKE", 17, BY_POSITION, Behaviour.HOLD, arms=False, needs_position=True),
        Mode("THROW", "THROW", 18, BY_POSITION, Behaviour.LEVEL, needs_position=True),
        Mode(
            "AVOID_ADSB",
            "AVOID_ADSB",
            19,
            BY_POSITION,
            Behaviour.HOLD,
            arms=False,
            needs_position=True,
        ),
        Mode("ZIGZAG", "ZIGZAG", 24, BY_POSITION, Behaviour.DESCEND, needs_position=True),
        Mode("GUIDED_NOGPS", "GUIDED_NOGPS", 20, BY_HAND, Behaviour.SETPOINT),
        Mode(
            "SMART_RTL",
            "SMARTRTL",
            21,
            BY_POSITION,
            Behaviour.RETURN,
            arms=False,
            needs_position=True,
        ),
    )
}


def heartbeat(now: Condition) -> tuple[int, int]:
    """base_mode and MAV_STATE: 1 booting, 3 on the ground, 4 in the air, 5 in trouble."""
    if "initialised" not in now.reached:
        return BY_POSITION, 1
    base_mode = BY_HAND if isinstance(now.setpoint, AttitudeSetpoint) else now.mode.base_mode
    if now.faulty or now.failsafe:
        return base_mode, 5
    return base_mode, 4 if now.armed and not now.landed else 3


_CUSTOM_MODE_ENABLED = 1
# Modes that it has and does not enter here, as it enters some only under conditions
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
    said = f"No such mode {number}"
    if number in _NOT_ENTERED:
        said = f"Mode change to {_NOT_ENTERED[number]}"
    return ModeRequest(known, Result.FAILED, None if known else Say(Severity.WARNING, said))


def set_mode(base_mode: int, custom_mode: int) -> ModeRequest:
    """SET_MODE: the mode's number is custom_mode."""
    return command_mode((base_mode, custom_mode))


def arm_wish(param: float) -> ArmWish:
    """1 arms, 0 disarms, anything else is not supported."""
    if param in (0.0, 1.0):
        return ArmWish("arm" if param else "disarm")
    return ArmWish(refusal=Result.UNSUPPORTED)


# Taken by their receivers, which change nothing that shows here, or failed without their devices
_TAKEN = (181, 195, 197, 203, 206, 207, 208, 401, 2001, 5300, 42001, 42003, 42424)
_FAILED = (84, 183, 184, 189, 193, 205, 211, 218, 500, 2000, 2500)
COMMAND_ANSWERS: dict[int, Result | None] = {
    **dict.fromkeys(_TAKEN, Result.ACCEPTED),
    **dict.fromkeys(_FAILED, Result.FAILED),
    532: Result.DENIED,
}
