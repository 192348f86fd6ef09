"""Tables of PX4: its flight modes, its parameters (those that clients read or that have an effect),
and its state table, which decides about events.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from simulator.autopilot.firmware import AFTER_DELAY, ByParameter, ParameterSpec, Role, Rule
from simulator.autopilot.values import (
    Behaviour,
    Mode,
    Result,
    Severity,
    StatusText,
    critical,
    info,
    warning,
)
from simulator.geodesy import GRAVITY_MPS2

# MAV_MODE_FLAG: 1 custom mode, 4 auto, 8 guided, 16 stabilise, 64 manual input
AUTO, OFFBOARD, RATES, MANUAL = 29, 17, 1, 81


def _by_sticks(name: str, title: str, number: int, behaviour: Behaviour) -> Mode:
    return Mode(name, title, number, MANUAL, behaviour, needs_sticks=True)


def _ends(name: str, title: str, number: int, behaviour: Behaviour) -> Mode:
    """A mode that ends on the ground: the vehicle is not armed in it and does not return to it."""
    return Mode(name, title, number, AUTO, behaviour, arms=False, remembered=False)


MODES = {
    mode.name: mode
    for mode in (
        Mode("AUTO.LOITER", "Hold", 0x03040000, AUTO, Behaviour.HOLD),
        Mode("AUTO.TAKEOFF", "Takeoff", 0x02040000, AUTO, Behaviour.TAKEOFF),
        _ends("AUTO.LAND", "Land", 0x06040000, Behaviour.LAND),
        _ends("AUTO.RTL", "Return", 0x05040000, Behaviour.RETURN),
        Mode("AUTO.MISSION", "Mission", 0x04040000, AUTO, Behaviour.MISSION),
        Mode("AUTO.FOLLOW", "Follow Target", 0x08040000, OFFBOARD, Behaviour.HOLD),
        _ends("AUTO.PRECLAND", "Precision Land", 0x09040000, Behaviour.LAND),
        Mode("ORBIT", "Orbit", 0x01030000, OFFBOARD, Behaviour.ORBIT),
        Mode("TERMINATION", "Termination", 0x000A0000, RATES, Behaviour.HOLD, arms=False),
        Mode("OFFBOARD", "Offboard", 0x00060000, OFFBOARD, Behaviour.SETPOINT),
        _by_sticks("POSCTL", "Position", 0x00030000, Behaviour.STICKS),
        _by_sticks("ALTCTL", "Altitude", 0x00020000, Behaviour.STICKS),
        _by_sticks("STABILIZED", "Stabilized", 0x00070000, Behaviour.COAST),
        _by_sticks("MANUAL", "Manual", 0x00010000, Behaviour.COAST),
        _by_sticks("ACRO", "Acro", 0x00050000, Behaviour.COAST),
    )
}


_GAINS = {
    "PITCH_P": 6.5, "ROLL_P": 6.5, "YAW_P": 2.8, "PITCHRATE_P": 0.15, "PITCHRATE_I": 0.2,
    "PITCHRATE_D": 0.003, "ROLLRATE_P": 0.15, "ROLLRATE_I": 0.2, "ROLLRATE_D": 0.003,
    "YAWRATE_P": 0.2, "YAWRATE_I": 0.1, "YAWRATE_D": 0.0,
}  # fmt: skip


def _real(name: str, default: float, low: float, high: float) -> ParameterSpec:
    return ParameterSpec(name, "real32", default, low, high)


def _int(name: str, default: int, low: int, high: int) -> ParameterSpec:
    return ParameterSpec(name, "int32", default, low, high)


PARAMETERS = (
    _int("BAT1_N_CELLS", 4, 1, 16),  # cells of the battery
    _real("BAT_CRIT_THR", 0.07, 0.05, 0.5),  # remaining share at which the battery is critical
    _real("BAT_EMERGEN_THR", 0.05, 0.03, 0.5),  # remaining share at which it is an emergency
    _real("BAT_LOW_THR", 0.15, 0.12, 0.5),  # remaining share at which the battery is low
    _int("CAL_ACC0_ID", 1310988, 0, 2147483647),  # calibrated accelerometer
    _int("CAL_GYRO0_ID", 1310988, 0, 2147483647),  # calibrated gyroscope
    _int("CAL_MAG0_ID", 197388, 0, 2147483647),  # calibrated magnetometer
    _int("CBRK_SUPPLY_CHK", 0, 0, 894281),  # without effect
    _int("COM_ARM_WO_GPS", 1, 0, 2),  # arm without GPS: 1 with a warning
    _real("COM_DISARM_LAND", 2.0, -1, 20),  # s from landing to disarming, < 0 never
    _real("COM_DISARM_PRFLT", 10.0, -1, 100),  # s armed without takeoff until disarming, < 0 never
    _int("COM_DL_LOSS_T", 10, 5, 300),  # s without ground station until it is lost
    _real("COM_FAIL_ACT_T", 5.0, 0, 25),  # s in Hold before the action of a failsafe
    _int("COM_LOW_BAT_ACT", 3, 0, 3),  # battery: 0 warning, 1 return, 2 land, 3 return or land
    _int("COM_OBL_RC_ACT", 0, 0, 5),  # offboard lost: POSCTL ALTCTL STABILIZED RTL LAND LOITER
    _real("COM_OF_LOSS_T", 1.0, 0, 60),  # s without setpoint until offboard is lost
    # modes without failsafe when sticks are lost, bits: 0 mission, 1 hold and takeoff, 2 offboard
    _int("COM_RCL_EXCEPT", 0, 0, 31),
    *(_int(f"COM_FLTMODE{at}", -1, -1, 15) for at in range(1, 7)),  # mode switch; without effect
    _int("COM_RC_IN_MODE", 1, 0, 4),  # manual input: 0 RC, 1 joystick, 4 none
    _real("COM_RC_LOSS_T", 0.5, 0, 35),  # s without sticks until they are lost
    _int("COM_RC_OVERRIDE", 1, 0, 3),  # moved sticks end bit 0 automatic modes, bit 1 offboard
    _real("COM_SPOOLUP_TIME", 1.0, 0, 30),  # s from arming until takeoff may begin
    _int("COM_TAKEOFF_ACT", 0, 0, 1),  # after takeoff: 0 hold
    _int("EKF2_NOAID_TOUT", 5000000, 500000, 10000000),  # us without aiding until position is lost
    _int("FLW_TGT_ALT_M", 0, 0, 2),  # follow-me, as the next five; without effect
    _real("FLW_TGT_DST", 8.0, 1, 1e6),  # m
    _real("FLW_TGT_FA", 180.0, -180, 180),  # deg
    _real("FLW_TGT_HT", 8.0, 8, 1e6),  # m
    _real("FLW_TGT_MAX_VEL", 5.0, 0, 20),  # m/s
    _real("FLW_TGT_RS", 0.1, 0, 1),  # responsiveness
    _int("GF_ACTION", 2, 0, 5),  # geofence: 2 hold
    _real("GF_MAX_HOR_DIST", 0.0, 0, 10000),  # m, geofence; without effect
    _real("GF_MAX_VER_DIST", 0.0, 0, 10000),  # m, geofence; without effect
    _real("LNDMC_TRIG_TIME", 1.0, 0.1, 10),  # s of each of three stages of land detection
    _int("MAV_SYS_ID", 1, 1, 250),  # system id; read at start
    _int("MAV_TYPE", 2, 0, 22),  # MAV_TYPE
    _real("MC_PITCHRATE_MAX", 220.0, 0, 1800),  # deg/s; without effect
    _real("MC_ROLLRATE_MAX", 220.0, 0, 1800),  # deg/s; without effect
    *(_real(f"MC_{name}", gain, 0, 20) for name, gain in _GAINS.items()),  # without effect
    _real("MIS_DIST_1WP", 10000.0, -1, 100000),  # m to the first waypoint; without effect
    _real("MIS_TAKEOFF_ALT", 2.5, 0, 80),  # m, takeoff height
    _int("MIS_TKO_LAND_REQ", 0, 0, 4),  # what a mission must have
    _real("MPC_ACC_DOWN_MAX", 3.0, 2, 15),  # m/s^2, downwards in automatic flight
    _real("MPC_ACC_HOR", 3.0, 2, 15),  # m/s^2, horizontal
    _real("MPC_HOLD_DZ", 0.1, 0, 1),  # dead zone of the sticks
    _real("MPC_LAND_ALT1", 10.0, 0, 122),  # m below which a descent slows down
    _real("MPC_LAND_ALT2", 5.0, 0, 122),  # m below which the speed is MPC_LAND_SPEED
    _real("MPC_LAND_ALT3", 1.0, 0, 122),  # m above ground, below which MPC_LAND_CRWL applies
    _real("MPC_LAND_CRWL", 0.3, 0.1, 10),  # m/s of descent just above the ground
    _real("MPC_LAND_SPEED", 0.7, 0.6, 10),  # m/s near the ground
    _real("MPC_MANTHR_MIN", 0.08, 0, 1),  # least thrust of stick flight
    _real("MPC_MAN_Y_MAX", 150.0, 0, 400),  # deg/s of turns by stick
    _real("MPC_THR_HOVER", 0.5, 0.1, 0.8),  # hover thrust, normalised
    _real("MPC_THR_MAX", 1.0, 0, 1),  # most thrust of the position loop
    _real("MPC_THR_MIN", 0.12, 0.05, 0.5),  # least thrust of the position loop
    _real("MPC_TILTMAX_AIR", 45.0, 20, 89),  # deg
    _real("MPC_TKO_RAMP_T", 3.0, 0, 5),  # s until the climb rate of a takeoff is reached
    _real("MPC_TKO_SPEED", 1.5, 1, 5),  # m/s of climb at takeoff
    _int("MPC_USE_HTE", 1, 0, 1),  # estimate the hover thrust
    _real("MPC_VEL_MANUAL", 10.0, 3, 20),  # m/s of stick flight
    _real("MPC_XY_CRUISE", 5.0, 3, 20),  # m/s, horizontal in automatic flight
    _real("MPC_XY_MAN_EXPO", 0.6, 0, 1),  # share of the cube of a stick's deflection
    _real("MPC_XY_P", 0.95, 0, 2),  # 1/s
    _real("MPC_XY_VEL_D_ACC", 0.2, 0.1, 2),  # -
    _real("MPC_XY_VEL_I_ACC", 0.4, 0, 60),  # 1/s^2
    _real("MPC_XY_VEL_MAX", 12.0, 0, 20),  # m/s
    _real("MPC_XY_VEL_P_ACC", 1.8, 1.2, 5),  # 1/s
    _real("MPC_YAWRAUTO_MAX", 45.0, 5, 360),  # deg/s of turns in automatic flight
    _int("MPC_YAW_MODE", 0, 0, 4),  # yaw of automatic flight: 0 towards the waypoint
    _real("MPC_Z_P", 1.0, 0.1, 1.5),  # 1/s
    _real("MPC_Z_VEL_D_ACC", 0.0, 0, 2),  # -
    _real("MPC_Z_VEL_I_ACC", 2.0, 0.2, 3),  # 1/s^2
    _real("MPC_Z_VEL_MAX_DN", 1.5, 0.5, 4),  # m/s
    _real("MPC_Z_VEL_MAX_UP", 3.0, 0.5, 8),  # m/s
    _real("MPC_Z_VEL_P_ACC", 4.0, 2, 15),  # 1/s
    _real("MPC_Z_V_AUTO_DN", 1.5, 0.5, 4),  # m/s of automatic descent
    _real("MPC_Z_V_AUTO_UP", 3.0, 0.5, 8),  # m/s of automatic climb
    _real("NAV_ACC_RAD", 2.0, 0.05, 200),  # m from a waypoint, within which it is reached
    _int("NAV_DLL_ACT", 0, 0, 6),  # ground station lost: 0 nothing, 1 hold, 2 return, 3 land
    _real("NAV_MC_ALT_RAD", 0.8, 0.05, 200),  # m from a height, within which it is reached
    _int("NAV_RCL_ACT", 2, 1, 6),  # sticks lost: 2 return
    _int("RC_MAP_THROTTLE", 0, 0, 18),  # channel of the throttle stick
    _int("RTL_CONE_ANG", 45, 0, 90),  # deg, of the cone above home within RTL_MIN_DIST
    _real("RTL_DESCEND_ALT", 10.0, 0, 100),  # m above home, height at which a return loiters
    _real("RTL_LAND_DELAY", 0.0, -1, 600),  # s of loiter at that height, < 0 without end
    _real("RTL_MIN_DIST", 10.0, 0.5, 100),  # m from home, within which RTL_CONE_ANG applies
    _real("RTL_RETURN_ALT", 30.0, 0, 150),  # m above home while returning
    _int("RTL_TYPE", 0, 0, 5),  # 0 home or rally point
    _int("SYS_AUTOCONFIG", 0, 0, 1),  # set up the airframe at start
    _int("SYS_AUTOSTART", 10040, 0, 9999999),  # airframe
    _int("SYS_FAILURE_EN", 0, 0, 1),  # failure injection; without effect
    _int("SYS_HAS_GPS", 1, 0, 1),  # 1: has GPS
)

# Names end with the unit. The comments explain roles for both firmwares, if the name does not
ROLES: dict[str, Role] = {
    "stream_timeout_s": "COM_OF_LOSS_T",
    # velocity innovation test ratio at which arming is refused, 0: no check; EKF2's before takeoff
    "velocity_ratio_most": 0.5,
    "disarm_landed_s": "COM_DISARM_LAND",
    "disarm_idle_s": "COM_DISARM_PRFLT",
    "takeoff_height_m": "MIS_TAKEOFF_ALT",
    "takeoff_speed_mps": "MPC_TKO_SPEED",
    "land_speed_mps": "MPC_LAND_SPEED",
    "descent_speed_mps": "MPC_Z_V_AUTO_DN",  # during a landing, far from the ground
    "cruise_speed_mps": "MPC_XY_CRUISE",
    "hover_thrust": "MPC_THR_HOVER",
    "hover_estimated": "MPC_USE_HTE",  # not 0: the hover thrust is estimated in flight
    "tilt_boost": 0.0,  # not 0: the thrust of a setpoint is divided by the cosine of the tilt
    "ground_station_timeout_s": "COM_DL_LOSS_T",
    "ground_station_needed": "NAV_DLL_ACT",  # greater than 0: arming needs a ground station
    "battery_patience_s": 0.0,  # duration of a battery level after which it is reported
    "failsafe_delay_s": "COM_FAIL_ACT_T",
    "spool_up_s": "COM_SPOOLUP_TIME",
    "takeoff_ramp_s": "MPC_TKO_RAMP_T",
    "ramp_ends_mps": "MPC_Z_VEL_MAX_UP",
    "climbed_within_m": "NAV_MC_ALT_RAD",
    "thrust_least": "MPC_THR_MIN",
    "stick_thrust_least": "MPC_MANTHR_MIN",
    "contact_s": "LNDMC_TRIG_TIME",
    "settled_s": ("LNDMC_TRIG_TIME", 2.0),
    "slow_below_m": "MPC_LAND_ALT2",
    "fast_above_m": "MPC_LAND_ALT1",
    "crawl_below_m": "MPC_LAND_ALT3",
    "crawl_speed_mps": "MPC_LAND_CRWL",
    "return_descends_to_m": "RTL_DESCEND_ALT",
    "reached_m": "NAV_ACC_RAD",
    "reached_height_m": "NAV_MC_ALT_RAD",
    "position_without_fix_s": ("EKF2_NOAID_TOUT", 1e-6),
    "return_waits_s": "RTL_LAND_DELAY",
    "return_settles_s": 0.0,
    # position loop: P on position (1/s), PID on velocity (acceleration out; P 1/s, I 1/s^2, D
    # without unit), and limits
    "position_xy_p": "MPC_XY_P",
    "position_z_p": "MPC_Z_P",
    "velocity_xy_p": "MPC_XY_VEL_P_ACC",
    "velocity_xy_i": "MPC_XY_VEL_I_ACC",
    "velocity_xy_d": "MPC_XY_VEL_D_ACC",
    "velocity_z_p": "MPC_Z_VEL_P_ACC",
    "velocity_z_i": "MPC_Z_VEL_I_ACC",
    "velocity_z_d": "MPC_Z_VEL_D_ACC",
    "integral_z_max_mps2": GRAVITY_MPS2,
    "speed_xy_mps": "MPC_XY_VEL_MAX",
    "speed_up_mps": "MPC_Z_VEL_MAX_UP",
    "speed_down_mps": "MPC_Z_VEL_MAX_DN",
    "tilt_max_rad": ("MPC_TILTMAX_AIR", math.radians(1.0)),
    "thrust_max": "MPC_THR_MAX",
    # automatic flight; PX4 limits the jerk (MPC_JERK_AUTO), which on average lowers both horizontal
    # accelerations
    "turn_radps": ("MPC_YAWRAUTO_MAX", math.radians(1.0)),
    "speeding_mps2": ("MPC_ACC_HOR", 0.7),
    "braking_mps2": ("MPC_ACC_HOR", 0.5),
    # a vehicle that stops brakes so, after a delay, as the jerk is limited
    "stopping_mps2": "MPC_ACC_HOR",
    "stopping_delay_s": 0.6,
    "vertical_mps2": ("MPC_ACC_DOWN_MAX", 0.5),
    # demanded speed above which the nose points in the direction of flight
    "facing_mps": lambda parameters: parameters["MPC_XY_P"] * parameters["NAV_ACC_RAD"],
    # land detector; thrust shares go from 0, the least thrust, to 1, the hover thrust
    # greatest thrust of a landing; so high because estimates may drift on the ground
    "low_thrust_share": 0.95,
    "idle_thrust_share": 0.1,  # more thrust than this is a takeoff
    "sinking_mps": 0.09,  # a demanded descent at this speed may be a landing
    # still_*: greatest estimated motion of a vehicle on the ground
    "still_down_mps": 0.2,
    "still_across_mps": 1.5,  # LNDMC_XY_VEL_MAX
    "still_radps": math.radians(20.0),  # LNDMC_ROT_MAX
    "stick_descent_mps": 0.6,  # in a manual mode without stick input
    "stick_timeout_s": "COM_RC_LOSS_T",
    "stick_dead_zone_us": ("MPC_HOLD_DZ", 500.0),
    "throttle_dead_zone_us": ("MPC_HOLD_DZ", 500.0),
    "stick_expo": "MPC_XY_MAN_EXPO",
    "stick_climb_mps": "MPC_Z_VEL_MAX_UP",
    "stick_sink_mps": "MPC_Z_VEL_MAX_DN",
    "stick_turn_radps": ("MPC_MAN_Y_MAX", math.radians(1.0)),
    "stick_speed_mps": "MPC_VEL_MANUAL",
    "stick_acceleration_mps2": "MPC_ACC_HOR",
    "stick_braking_mps2": "MPC_ACC_HOR",
    "stick_brakes_after_s": 0.3,  # with centred sticks
    "setpoint_spool_s": 0.0,  # from arming until the thrust of an attitude setpoint is applied
    "stream_reaction_s": 0.036,  # from the timeout of the setpoints until they count as lost
    # time for which a ground station counts as connected after a HEARTBEAT; the timeout follows
    "ground_station_stays_s": 2.5,
}


_LATER = Result.TEMPORARILY_REJECTED
_LOST = critical("Failsafe activated")
_NOT_AVAILABLE = critical("Switching to {mode} is currently not available")

_THROTTLE_RAISED = critical("Arming denied: throttle above center")
_NO_MISSION = critical("Mission start denied! No valid mission")
_CLEARED = critical("No valid mission available, loitering")
_RTL, _LAND, _MISSION = "AUTO.RTL", "AUTO.LAND", "AUTO.MISSION"
_LANDED = ("landed",)
_AUTOMATIC = " ".join(name for name in MODES if name.startswith("AUTO."))
_TAKEN = info("Pilot took over using sticks")
_WITHOUT_STREAM = {0: "POSCTL", 1: "ALTCTL", 2: "STABILIZED", 3: _RTL, 4: _LAND, 5: "AUTO.LOITER"}
_REGAINED = info("GCS connection regained")
_WARNINGS = {
    "battery low": StatusText(Severity.EMERGENCY, "Low battery"),
    "battery critical": StatusText(Severity.EMERGENCY, "Critical battery"),
    "battery emergency": StatusText(Severity.EMERGENCY, "Emergency battery level"),
    "ground station lost": info("Connection to ground station lost"),
}


def _delayed(event: str, parameter: str, modes: Mapping[int, str]) -> tuple[Rule, ...]:
    """Rows of a failsafe with delay: first Hold, so that a pilot can take over, then the mode that
    the parameter selects. A second failsafe during the delay changes only that mode."""
    values = ",".join(map(str, modes))
    hold = critical("Failsafe activated: entering Hold for {delay_s:.0f} seconds")
    texts = (_WARNINGS[event],) if event in _WARNINGS else ()
    return (
        Rule(event, when=("action delayed",), do=("failsafe", "delay"), texts=texts),
        Rule(
            event,
            when=("armed", "not landed", f"{parameter}={values}"),
            to="AUTO.LOITER",
            do=("failsafe", "delay"),
            texts=(*texts, hold),
        ),
        Rule(
            event + AFTER_DELAY,
            when=(f"since {event}",),
            to=ByParameter(parameter, modes),
            do=("failsafe",),
            texts=(_LOST,),
        ),
    )


def _says(
    event: str,
    text: StatusText,
    *when: str,
    to: str = "*",
    do: tuple[str, ...] = (),
    result: Result = Result.ACCEPTED,
) -> Rule:
    """A row with one text."""
    return Rule(event, when=when, to=to, do=do, result=result, texts=(text,))


def _disarms(event: str, *texts: str, when: tuple[str, ...] = ()) -> Rule:
    """A row that disarms and returns to the mode chosen last."""
    return Rule(event, when=when, do=("disarm",), to="remembered", texts=tuple(map(info, texts)))


RULES = (
    _says("mode", _NOT_AVAILABLE, "latched terminate", result=_LATER),
    Rule("mode", when=("not armed",), to="requested"),
    Rule("mode", when=("mode can run",), to="requested"),
    Rule("mode", when=("requested by ground station",), result=_LATER, texts=(_NOT_AVAILABLE,)),
    Rule("mode", result=_LATER),
    Rule("takeoff", to="AUTO.TAKEOFF"),
    Rule("orbit", to="ORBIT"),
    Rule("land", to="AUTO.LAND", texts=(info("Landing at current position"),)),
    Rule("return", to="AUTO.RTL", texts=(info("Returning to launch"),)),
    Rule("arm", when=("armed",)),
    _says("arm", _THROTTLE_RAISED, "mode needs sticks", "throttle raised", result=_LATER),
    Rule("arm", when=("ready",), do=("arm",), texts=(info("Armed by external command"),)),
    _says("arm", critical("Arming denied: Resolve system health failures first"), result=_LATER),
    _says("checks", critical("Preflight Fail: horizontal velocity unstable"), "velocity rejected"),
    _says("checks", critical("Preflight Fail: GPS fix too low"), "fix missing", "COM_ARM_WO_GPS=0"),
    _says("checks", warning("Preflight: GPS fix too low"), "fix missing", "COM_ARM_WO_GPS=1"),
    Rule("force arm", when=("armed",)),
    Rule("force arm", do=("arm",), texts=(info("Armed by external command"),)),
    Rule("disarm", when=("not armed",)),
    _disarms("disarm", "Disarmed by external command", when=_LANDED),
    Rule("disarm", result=_LATER, texts=(critical("Disarming denied: not landed"),)),
    Rule("force disarm", when=("not armed",)),
    _disarms("force disarm", "Disarmed by external command"),
    Rule("terminate", when=("not armed",), result=Result.DENIED),
    Rule("terminate", to="TERMINATION", do=("disarm", "latch"), texts=(_LOST,)),
    Rule(
        "stream lost",
        "OFFBOARD",
        when=("armed",),
        to=ByParameter("COM_OBL_RC_ACT", _WITHOUT_STREAM),
        do=("failsafe",),
        texts=(_LOST,),
    ),
    Rule("stream found", when=("since stream lost",), to="remembered", do=("recover",)),
    *_delayed("battery critical", "COM_LOW_BAT_ACT", {1: _RTL, 2: _LAND, 3: _RTL}),
    *_delayed("battery emergency", "COM_LOW_BAT_ACT", {1: _RTL, 2: _LAND, 3: _LAND}),
    # the vehicle continues a landing
    Rule(
        "ground station lost", "AUTO.LAND AUTO.PRECLAND", texts=(_WARNINGS["ground station lost"],)
    ),
    *_delayed("ground station lost", "NAV_DLL_ACT", {2: _RTL, 3: _LAND}),
    Rule(
        "ground station lost",
        when=("armed", "not landed", "NAV_DLL_ACT=1"),
        to="AUTO.LOITER",
        do=("failsafe",),
        texts=(_WARNINGS["ground station lost"], _LOST),
    ),
    Rule("battery low", when=("armed",), texts=(_WARNINGS["battery low"], _LOST)),
    *(Rule(event, texts=(text,)) for event, text in _WARNINGS.items()),
    Rule("ground station found", texts=(_REGAINED,)),
    Rule("sticks lost", "AUTO.MISSION", when=("COM_RCL_EXCEPT&1",)),
    Rule("sticks lost", "AUTO.LOITER AUTO.TAKEOFF", when=("COM_RCL_EXCEPT&2",)),
    Rule("sticks lost", "OFFBOARD", when=("COM_RCL_EXCEPT&4",)),
    *_delayed("sticks lost", "NAV_RCL_ACT", {2: _RTL, 3: _LAND}),
    Rule(
        "sticks lost",
        when=("armed", "not landed", "NAV_RCL_ACT=1"),
        to="AUTO.LOITER",
        do=("failsafe",),
        texts=(_LOST,),
    ),
    Rule(
        "sticks moved",
        _AUTOMATIC,
        when=("armed", "COM_RC_OVERRIDE&1"),
        to="POSCTL",
        texts=(_TAKEN,),
    ),
    Rule(
        "sticks moved",
        "OFFBOARD",
        when=("armed", "COM_RC_OVERRIDE&2"),
        to="POSCTL",
        texts=(_TAKEN,),
    ),
    Rule("position lost", "OFFBOARD", when=("not motion setpoint",)),
    Rule("position lost", when=("armed", "not landed"), to=_LAND, do=("failsafe",), texts=(_LOST,)),
    Rule("position found", when=("since position lost",), to="remembered", do=("recover",)),
    Rule("climbed", "AUTO.TAKEOFF", to="AUTO.LOITER"),
    Rule("already higher", texts=(critical("Already higher than takeoff altitude"),)),
    _says("mission", _NO_MISSION, "mission missing", result=Result.DENIED),
    Rule("mission", when=("armed",), to=_MISSION),
    _says("mission", info("Armed by mission start"), "ready", to=_MISSION, do=("arm",)),
    _says("mission", critical("Switching to Mission is currently not available"), result=_LATER),
    Rule("mission progress", send=("MISSION_CURRENT",)),
    Rule("item reached", send=("MISSION_ITEM_REACHED",)),
    Rule("mission return", "AUTO.MISSION", to="AUTO.RTL", texts=(info("Returning to launch"),)),
    Rule("mission cleared", "AUTO.MISSION", to="AUTO.LOITER", texts=(_CLEARED,)),
    _disarms("mission finished", "Mission finished, landed", "Disarmed by landing", when=_LANDED),
    Rule("mission finished", texts=(info("Mission finished, loitering"),)),
    Rule("home"),
    Rule("speed"),
    Rule("reboot", result=Result.DENIED),  # as in PX4's SITL, which cannot reboot
    Rule("took off", texts=(info("Takeoff detected"),)),
    Rule("landed", texts=(info("Landing detected"),)),
    _disarms("settled", "Disarmed by landing"),
    _disarms("idle", "Disarmed by auto preflight disarming"),
)
