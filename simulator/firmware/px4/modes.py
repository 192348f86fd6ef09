"""PX4's flight modes, the command that asks for them, and what a heartbeat shows."""

from __future__ import annotations

import math

from simulator.firmware.base import Behaviour, Condition, Mode, ModeRequest, Result

# MAV_MODE_FLAG: 1 custom mode, 4 auto, 8 guided, 16 stabilise, 64 manual input
AUTO, OFFBOARD, MANUAL = 29, 17, 81

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
        Mode("OFFBOARD", "Offboard", 0x00060000, OFFBOARD, Behaviour.SETPOINT),
        Mode("POSCTL", "Position", 0x00030000, MANUAL, Behaviour.DESCEND, needs_sticks=True),
        Mode("ALTCTL", "Altitude", 0x00020000, MANUAL, Behaviour.DESCEND, needs_sticks=True),
        Mode("STABILIZED", "Stabilized", 0x00070000, MANUAL, Behaviour.LEVEL, needs_sticks=True),
    )
}

# PX4_CUSTOM_MAIN_MODE, PX4_CUSTOM_SUB_MODE_AUTO
_MAIN = {2: "ALTCTL", 3: "POSCTL", 6: "OFFBOARD", 7: "STABILIZED"}
_AUTO_SUB = {
    2: "AUTO.TAKEOFF",
    3: "AUTO.LOITER",
    4: "AUTO.MISSION",
    5: "AUTO.RTL",
    6: "AUTO.LAND",
}
_CUSTOM_MODE_ENABLED = 1


def heartbeat(now: Condition) -> tuple[int, int]:
    """base_mode and MAV_STATE; offboard that never had a setpoint shows only "custom mode"."""
    waits = now.mode.behaviour is Behaviour.SETPOINT and now.setpoint is None
    base_mode = 1 if waits else now.mode.base_mode
    if now.armed:
        return base_mode, 5 if now.failsafe else 4
    return base_mode, 3 if now.healthy else 0


def command_mode(params: tuple[float, ...]) -> ModeRequest:
    """MAV_CMD_DO_SET_MODE (176): param1 base mode, param2 main mode, param3 sub mode of AUTO."""
    base, main, sub = (int(p) if math.isfinite(p) else 0 for p in params[:3])
    if not base & _CUSTOM_MODE_ENABLED:
        return ModeRequest(None, Result.DENIED)
    if main == 4:
        return ModeRequest(_AUTO_SUB.get(sub), Result.TEMPORARILY_REJECTED)
    return ModeRequest(_MAIN.get(main), Result.DENIED)
