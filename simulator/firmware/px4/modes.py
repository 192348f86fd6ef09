"""Flight modes of PX4, and its heartbeat."""

from __future__ import annotations

from simulator.firmware.values import AttitudeSetpoint, Behaviour, Condition, Mode

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


def heartbeat(now: Condition) -> tuple[int, int]:
    """base_mode and MAV_STATE. In Offboard base_mode shows which control loops run: none before
    the first setpoint, the rate loop only for rate setpoints."""
    base_mode = now.mode.base_mode
    if now.mode.behaviour is Behaviour.SETPOINT:
        attitude = now.setpoint if isinstance(now.setpoint, AttitudeSetpoint) else None
        rates_alone = attitude is not None and attitude.rates_frd_radps is not None
        base_mode = RATES if now.setpoint is None or rates_alone else OFFBOARD
    if now.armed:
        return base_mode, 5 if now.failsafe else 4
    return base_mode, 3 if now.healthy else 0
