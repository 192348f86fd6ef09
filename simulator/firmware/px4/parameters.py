"""PX4's parameters: those that clients read and those that the vehicle obeys."""

from __future__ import annotations

from simulator.firmware.base import ParameterSpec, Role


def _real(name: str, default: float, low: float, high: float, meaning: str) -> ParameterSpec:
    return ParameterSpec(name, "real32", default, low, high, meaning)


def _int(name: str, default: int, low: int, high: int, meaning: str) -> ParameterSpec:
    return ParameterSpec(name, "int32", default, low, high, meaning)


PARAMETERS = (
    _real("BAT_CRIT_THR", 0.07, 0.05, 0.5, "share of the battery that is critical"),
    _real("BAT_EMERGEN_THR", 0.05, 0.03, 0.5, "share of the battery that is an emergency"),
    _real("BAT_LOW_THR", 0.15, 0.12, 0.5, "share of the battery that is low"),
    _int("COM_DL_LOSS_T", 10, 5, 300, "s without ground station until it is lost"),
    _real("COM_DISARM_LAND", 2.0, -1, 20, "s from landing to disarming, < 0 never"),
    _real("COM_DISARM_PRFLT", 10.0, -1, 100, "s armed without takeoff until disarming, < 0 never"),
    _real("COM_FAIL_ACT_T", 5.0, 0, 25, "s of hold before a failsafe is carried out"),
    _int("COM_LOW_BAT_ACT", 0, 0, 3, "battery: 0 warning, 1 return, 2 land, 3 return or land"),
    _int("COM_OBL_RC_ACT", 0, 0, 5, "offboard lost: POSCTL ALTCTL STABILIZED RTL LAND LOITER"),
    _real("COM_OF_LOSS_T", 1.0, 0, 60, "s without setpoint until offboard is lost"),
    _int("COM_RCL_EXCEPT", 0, 0, 31, "modes in which lost sticks do not matter, bit 2 offboard"),
    _int("COM_RC_IN_MODE", 1, 0, 4, "manual input: 0 RC, 1 joystick, 4 none"),
    _int("MAV_SYS_ID", 1, 1, 250, "system id; read at start"),
    _int("MAV_TYPE", 2, 0, 22, "MAV_TYPE"),
    _real("MIS_TAKEOFF_ALT", 2.5, 0, 80, "m, takeoff height"),
    _real("MPC_LAND_SPEED", 0.7, 0.6, 10, "m/s near the ground"),
    _real("MPC_THR_HOVER", 0.5, 0.1, 0.8, "normalised thrust believed to hover"),
    _real("MPC_TKO_SPEED", 1.5, 1, 5, "m/s of climb at takeoff"),
    _real("MPC_XY_CRUISE", 5.0, 3, 20, "m/s of automatic flight"),
    _real("MPC_Z_V_AUTO_DN", 1.5, 0.5, 4, "m/s of automatic descent"),
    _int("NAV_DLL_ACT", 0, 0, 6, "ground station lost: 0 nothing, 1 hold, 2 return, 3 land"),
    _int("NAV_RCL_ACT", 2, 1, 6, "sticks lost: 2 return"),
    _real("RTL_RETURN_ALT", 30.0, 0, 150, "m above home while returning"),
    _int("SYS_AUTOSTART", 10040, 0, 9999999, "airframe"),
)

ROLES: dict[str, Role] = {
    "stream_timeout_s": "COM_OF_LOSS_T",
    "disarm_landed_s": "COM_DISARM_LAND",
    "disarm_idle_s": "COM_DISARM_PRFLT",
    "takeoff_height_m": "MIS_TAKEOFF_ALT",
    "takeoff_speed_mps": "MPC_TKO_SPEED",
    "land_speed_mps": "MPC_LAND_SPEED",
    "descent_speed_mps": "MPC_Z_V_AUTO_DN",
    "cruise_speed_mps": "MPC_XY_CRUISE",
    "return_height_m": "RTL_RETURN_ALT",
    "hover_thrust": "MPC_THR_HOVER",
    "tilt_boost": 0.0,
    "ground_station_timeout_s": "COM_DL_LOSS_T",
    "failsafe_delay_s": "COM_FAIL_ACT_T",
}
