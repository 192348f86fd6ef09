"""Flight modes of ArduCopter, and its heartbeat."""

from __future__ import annotations

from simulator.firmware.values import AttitudeSetpoint, Behaviour, Condition, Mode

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
