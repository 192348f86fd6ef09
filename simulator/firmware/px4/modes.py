"""PX4's flight modes, the command that asks for them, and what a heartbeat shows."""

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

# MAV_MODE_FLAG: 1 custom mode, 4 auto, 8 guided, 16 stabilise, 64 manual input
AUTO, OFFBOARD, RATES, MANUAL = 29, 17, 1, 81


def _by_sticks(name: str, title: str, number: int, behaviour: Behaviour) -> Mode:
    return Mode(name, title, number, MANUAL, behaviour, arms=False, needs_sticks=True)


MODES = {
    mode.name: mode
    for mode in (
        Mode("AUTO.LOITER", "Hold", 0x03040000, AUTO, Behaviour.HOLD),
        Mode("AUTO.TAKEOFF", "Takeoff", 0x02040000, AUTO, Behaviour.TAKEOFF),
        Mode("AUTO.LAND", "Land", 0x06040000, AUTO, Behaviour.LAND, arms=False, remembered=False),
        Mode(
            "AUTO.RTL", "Return", 0x05040000, AUTO, Behaviour.RETURN, arms=False, remembered=False
        ),
        Mode("AUTO.MISSION", "Mission", 0x04040000, AUTO, Behaviour.MISSION),
        Mode("AUTO.FOLLOW", "Follow Target", 0x08040000, AUTO, Behaviour.HOLD),
        Mode(
            "AUTO.PRECLAND",
            "Precision Land",
            0x09040000,
            AUTO,
            Behaviour.LAND,
            arms=False,
            remembered=False,
        ),
        Mode("OFFBOARD", "Offboard", 0x00060000, OFFBOARD, Behaviour.SETPOINT),
        _by_sticks("POSCTL", "Position", 0x00030000, Behaviour.DESCEND),
        _by_sticks("ALTCTL", "Altitude", 0x00020000, Behaviour.DESCEND),
        _by_sticks("STABILIZED", "Stabilized", 0x00070000, Behaviour.COAST),
        _by_sticks("MANUAL", "Manual", 0x00010000, Behaviour.COAST),
        _by_sticks("ACRO", "Acro", 0x00050000, Behaviour.COAST),
    )
}

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
_NO_AUTO_MODE = Say(Severity.CRITICAL, "Unsupported auto mode")


def heartbeat(now: Condition) -> tuple[int, int]:
    """base_mode and MAV_STATE. Offboard shows which loops run: none before the first setpoint,
    none but the rates' when these are flown."""
    base_mode = now.mode.base_mode
    if now.mode.behaviour is Behaviour.SETPOINT:
        attitude = now.setpoint if isinstance(now.setpoint, AttitudeSetpoint) else None
        rates_alone = attitude is not None and attitude.rates_frd_radps is not None
        base_mode = RATES if now.setpoint is None or rates_alone else OFFBOARD
    if now.armed:
        return base_mode, 5 if now.failsafe else 4
    return base_mode, 3 if now.healthy else 0


def command_mode(params: tuple[float, ...]) -> ModeRequest:
    """MAV_CMD_DO_SET_MODE (176): param1 base mode, param2 main mode, param3 sub mode of AUTO.

    An unknown main mode, or a base mode alone, is accepted and changes nothing.
    """
    base, main, sub = (int(p) if math.isfinite(p) else 0 for p in params[:3])
    if not base & _CUSTOM_MODE_ENABLED:
        return ModeRequest(None, Result.ACCEPTED)
    if main == 4:
        known = _AUTO_SUB.get(sub)
        said = None if known else _NO_AUTO_MODE
        return ModeRequest(known, Result.TEMPORARILY_REJECTED, said)
    return ModeRequest(_MAIN.get(main), Result.ACCEPTED)


def set_mode(base_mode: int, custom_mode: int) -> ModeRequest:
    """SET_MODE: main mode in the third byte of custom_mode, sub mode in the fourth."""
    return command_mode((base_mode, custom_mode >> 16 & 0xFF, custom_mode >> 24))


def arm_wish(param: float) -> ArmWish:
    """Rounded; what is not a number disarms."""
    wish = math.floor(param + 0.5) if math.isfinite(param) else 0
    if wish in (0, 1):
        return ArmWish("arm" if wish else "disarm")
    text = f"Unsupported ARM_DISARM param: {param:.3f}"
    return ArmWish(say=Say(Severity.CRITICAL, text))


# Taken by its receivers, which change nothing that shows here, or do not answer
_TAKEN = (80, 187, 191, 195, 197, 201, 401, 519, 525, 528)
_UNANSWERED = (
    1, 93, 203, 204, 205, 206, 214, 220, 242, 243, 260, 310, 420, 500, 521, 530, 531, 532, 3000
)  # fmt: skip
COMMAND_ANSWERS: dict[int, Result | None] = {
    **dict.fromkeys(_TAKEN, Result.ACCEPTED),
    **dict.fromkeys(_UNANSWERED),
    189: Result.CANCELLED,
    211: Result.DENIED,
    224: Result.UNSUPPORTED,  # MISSION_SET_CURRENT does it
}
