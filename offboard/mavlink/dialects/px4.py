"""PX4 1.14 and later."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

from offboard.mavlink.dialects.base import (
    RATE_LIMIT,
    TRACKING_TELEMETRY,
    Dialect,
    SetpointLoss,
    Valid,
    WantedMessage,
    WatchedParameter,
)


def _custom_mode(main: int, sub: int = 0) -> int:
    return main << 16 | sub << 24


# PX4 acknowledges MAV_CMD_DO_SET_MODE twice: on receipt, and up to 12 ms later with the result
def _mode_parameters(custom_mode: int) -> tuple[float, ...]:
    return float(custom_mode >> 16 & 0xFF), float(custom_mode >> 24)


_NO_STICKS = 4.0  # COM_RC_IN_MODE


def _misses_sticks(known: Mapping[str, float], radio: bool) -> bool:
    return not radio and known.get("COM_RC_IN_MODE", _NO_STICKS) != _NO_STICKS


# modes in the order of the values of COM_OBL_RC_ACT; if PX4 cannot enter the chosen mode, it enters
# a later one of _LOSS_ORDER
_LOSS_MODES = ("POSCTL", "ALTCTL", "STABILIZED", "AUTO.RTL", "AUTO.LAND", "AUTO.LOITER")
_LOSS_ORDER = ("POSCTL", "ALTCTL", "STABILIZED", "AUTO.LOITER", "AUTO.RTL", "AUTO.LAND")


def _setpoint_loss(parameters: Mapping[str, float]) -> SetpointLoss:
    after_s, action = parameters.get("COM_OF_LOSS_T", 1.0), parameters.get("COM_OBL_RC_ACT")
    if action is None:
        return SetpointLoss(after_s, _LOSS_MODES)
    if not 0.0 <= action < len(_LOSS_MODES):
        return SetpointLoss(after_s)
    chosen = _LOSS_ORDER.index(_LOSS_MODES[int(action)])
    return SetpointLoss(after_s, _LOSS_ORDER[chosen:])


_RATES = "MC_ROLLRATE_MAX", "MC_PITCHRATE_MAX"
_MODES = {
    _custom_mode(1): "MANUAL",
    _custom_mode(2): "ALTCTL",
    _custom_mode(3): "POSCTL",
    _custom_mode(3, 1): "POSCTL.ORBIT",
    _custom_mode(4, 1): "AUTO.READY",
    _custom_mode(4, 2): "AUTO.TAKEOFF",
    _custom_mode(4, 3): "AUTO.LOITER",
    _custom_mode(4, 4): "AUTO.MISSION",
    _custom_mode(4, 5): "AUTO.RTL",
    _custom_mode(4, 6): "AUTO.LAND",
    _custom_mode(4, 8): "AUTO.FOLLOW_TARGET",
    _custom_mode(4, 9): "AUTO.PRECLAND",
    _custom_mode(4, 10): "AUTO.VTOL_TAKEOFF",
    _custom_mode(5): "ACRO",
    _custom_mode(6): "OFFBOARD",
    _custom_mode(7): "STABILIZED",
    _custom_mode(10): "TERMINATION",
}

PX4 = Dialect(
    name="px4",
    mav_autopilot=12,
    modes=MappingProxyType(_MODES),
    mode_parameters=_mode_parameters,
    engage_mode="OFFBOARD",
    hold_mode="AUTO.LOITER",
    land_mode="AUTO.LAND",
    return_mode="AUTO.RTL",
    assisted_modes=("POSCTL", "ALTCTL"),
    takes_off_by_command=False,
    unused_parameter=float("nan"),  # 0 would be a valid latitude
    divides_by_tilt=False,
    integers_bytewise=True,
    watched_parameters=(
        WatchedParameter("MPC_THR_HOVER", "normalised thrust that holds the weight"),
        WatchedParameter(
            "COM_OF_LOSS_T",
            "seconds without setpoints before the failsafe",
            Valid(lowest=0.3, highest=5.0, set_to=1.0),
            advice=(
                Valid(
                    "its failsafe acts before the supervisor, which lands it if we stop",
                    1.0,
                    lowest=0.6,
                ),
            ),
        ),
        WatchedParameter(
            "COM_OBL_RC_ACT",
            "what the vehicle does when setpoints stop; 6 and 7 stop the motors",
            Valid(lowest=0.0, highest=5.0, set_to=4.0),  # PX4's default 0 needs sticks
            values=(
                "Position",
                "Altitude",
                "Stabilized",
                "Return",
                "Land",
                "Hold",
                "Terminate",
                "Disarm",
            ),
            advice=(
                Valid(
                    "when setpoints stop, the vehicle enters a mode that is flown by sticks, and "
                    "no radio is received",
                    4.0,
                    lowest=3.0,
                    applies=lambda _, radio: not radio,
                ),
            ),
        ),
        WatchedParameter(
            "COM_RC_IN_MODE",
            "whether a radio or a joystick is used",
            values=("radio", "joystick", "radio or joystick", "the first of both", "disabled"),
            advice=(Valid("a pilot cannot take over by sticks", 3.0, highest=3.0),),
        ),
        WatchedParameter(
            "COM_RCL_EXCEPT",
            "modes in which a lost radio is no failsafe; 4 is OFFBOARD",
            advice=(
                Valid(
                    "without 4, a radio or joystick that is received for a moment and lost again "
                    "ends OFFBOARD; none is received now",
                    bits=4,
                    applies=_misses_sticks,
                ),
            ),
        ),
        WatchedParameter("NAV_RCL_ACT", "what the vehicle does when the radio is lost"),
        WatchedParameter("NAV_DLL_ACT", "what the vehicle does when the ground station is lost"),
        WatchedParameter("MPC_TILTMAX_AIR", "greatest tilt of its own modes, degrees"),
        *(WatchedParameter(each, "greatest angular rate, degree/s") for each in _RATES),
    ),
    hover_parameter="MPC_THR_HOVER",
    tilt_parameters=MappingProxyType({"MPC_TILTMAX_AIR": math.radians(1.0)}),
    tilting_parameters=MappingProxyType(dict.fromkeys(_RATES, (RATE_LIMIT, math.radians(1.0)))),
    estimator_message="ESTIMATOR_STATUS",
    slow_hint="raise MAV_x_RATE of this link, in bytes/s: PX4 slows all messages down to it",
    # PX4 sends these texts only on a link on which it receives a HEARTBEAT of type GCS. Ours has
    # another type, since PX4 would not notice the loss of its real ground station (NAV_DLL_ACT)
    unsaid=(
        "PX4 sends the reason to ground stations only: see QGroundControl; unless NAV_DLL_ACT is "
        "0, PX4 needs one"
    ),
    oldest=(1, 14),
    setpoint_loss=_setpoint_loss,
    defects=MappingProxyType(
        {
            "setpoints without thrust keep OFFBOARD alive; ours always have thrust": (1, 17),
            "COM_OBL_RC_ACT 0 to 2 selects a mode with sticks, also without RC": (1, 17),
        }
    ),
    wanted=(
        *TRACKING_TELEMETRY,
        # shows a change of mode within 0.02 s; HEARTBEAT has a fixed rate of 1 Hz
        WantedMessage("CURRENT_MODE", 50.0, optional=True, unchanged_hz=2.0),
        WantedMessage("ESTIMATOR_STATUS", 2.0, optional=True),
        WantedMessage("HIL_STATE_QUATERNION", 50.0, optional=True),  # true state, from a simulator
    ),
)
