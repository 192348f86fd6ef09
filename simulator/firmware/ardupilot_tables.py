"""Tables of ArduCopter: its flight modes, its parameters (those that clients read or that have an
effect), and its state table, which decides about events.

ArduCopter uses values outside the documented range, so the limits are those of the type, except for
values that it raises itself or with which it refuses to arm.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from simulator.autopilot.firmware import RANGES, ByParameter, ParameterSpec, Role, Rule
from simulator.autopilot.values import Behaviour, Mode, Result, StatusText, critical, info, warning
from simulator.geodesy import GRAVITY_MPS2

# MAV_MODE_FLAG: 1 custom mode, 8 guided, 16 stabilise, 64 manual input. "Guided" does not mean the
# mode, but that the position controller runs.
BY_POSITION, BY_HAND = 89, 81


def _by_position(name: str, number: int, behaviour: Behaviour, *, arms: bool = True) -> Mode:
    return Mode(name, name, number, BY_POSITION, behaviour, arms=arms, needs_position=True)


MODES = {
    mode.name: mode
    for mode in (
        Mode("STABILIZE", "STABILIZE", 0, BY_HAND, Behaviour.LEVEL),
        Mode("ACRO", "ACRO", 1, BY_HAND, Behaviour.LEVEL),
        Mode("ALT_HOLD", "ALT_HOLD", 2, BY_HAND, Behaviour.STICKS),
        _by_position("AUTO", 3, Behaviour.MISSION, arms=False),
        _by_position("GUIDED", 4, Behaviour.SETPOINT),
        _by_position("LOITER", 5, Behaviour.STICKS),
        _by_position("RTL", 6, Behaviour.RETURN, arms=False),
        _by_position("CIRCLE", 7, Behaviour.STICKS, arms=False),
        Mode("LAND", "LAND", 9, BY_POSITION, Behaviour.LAND, arms=False),
        Mode("DRIFT", "DRIFT", 11, BY_HAND, Behaviour.STICKS, needs_position=True),
        _by_position("POSHOLD", 16, Behaviour.STICKS),
        _by_position("BRAKE", 17, Behaviour.HOLD, arms=False),
        _by_position("THROW", 18, Behaviour.LEVEL),
        _by_position("AVOID_ADSB", 19, Behaviour.HOLD, arms=False),
        _by_position("ZIGZAG", 24, Behaviour.STICKS),
        Mode("GUIDED_NOGPS", "GUIDED_NOGPS", 20, BY_HAND, Behaviour.SETPOINT),
        replace(_by_position("SMART_RTL", 21, Behaviour.RETURN, arms=False), title="SMARTRTL"),
    )
}


def _real(name: str, default: float, least: float = -3.4e38) -> ParameterSpec:
    return ParameterSpec(name, "real32", default, least, 3.4e38)


def _int8(name: str, default: int) -> ParameterSpec:
    return ParameterSpec(name, "int8", default, *RANGES["int8"])


def _int16(name: str, default: int) -> ParameterSpec:
    return ParameterSpec(name, "int16", default, *RANGES["int16"])


def _int32(name: str, default: int) -> ParameterSpec:
    return ParameterSpec(name, "int32", default, *RANGES["int32"])


PARAMETERS = (
    _int8("AHRS_EKF_TYPE", 3),  # estimator, 3 EKF3; without effect
    ParameterSpec("ANGLE_MAX", "int16", 3000, 1000, 8000),  # cdeg, tilt limit of position control
    _int32("ARMING_CHECK", 1),  # pre-arm checks, 1 all
    _real("ATC_ACCEL_P_MAX", 110000.0),  # cdeg/s^2 of pitch
    _real("ATC_ACCEL_R_MAX", 110000.0),  # cdeg/s^2 of roll
    _int8("ATC_ANGLE_BOOST", 1),  # divide thrust by the cosine of the tilt
    _real("ATC_INPUT_TC", 0.15),  # s, shaping of demanded attitudes
    _real("ATC_RATE_P_MAX", 0.0),  # deg/s of pitch, 0 no limit; without effect
    _real("ATC_RATE_R_MAX", 0.0),  # deg/s of roll, 0 no limit; without effect
    _real("ATC_SLEW_YAW", 6000.0),  # cdeg/s, largest yaw rate
    _int32("AUTO_OPTIONS", 0),  # bit 0 arms in AUTO
    _real("BATT_ARM_VOLT", 0.0),  # V below which arming is refused, 0 off
    _int32("BATT_CAPACITY", 3300),  # mAh
    _real("BATT_CRT_MAH", 0.0),  # mAh left at which it is critical, 0 off
    _real("BATT_CRT_VOLT", 0.0),  # V below which it is critical, 0 off
    _int8("BATT_FS_CRT_ACT", 0),  # battery critical: 0 nothing, 1 LAND, 2 RTL, 3 or 4 SMART_RTL
    _int8("BATT_FS_LOW_ACT", 0),  # battery low: 0 nothing, 1 LAND, 2 RTL, 3 or 4 SMART_RTL
    _real("BATT_LOW_MAH", 0.0),  # mAh left at which it is low, 0 off
    _int8("BATT_LOW_TIMER", 10),  # s below the limit until the failsafe acts
    _real("BATT_LOW_VOLT", 10.5),  # V below which it is low, 0 off
    _int8("BATT_MONITOR", 4),  # battery monitor, 4 voltage and current
    _real("CIRCLE_RADIUS", 1000.0),  # cm; without effect
    _int8("COMPASS_USE", 1),  # without effect
    _int8("DISARM_DELAY", 10),  # s armed on the ground until disarming, 0 never
    _int8("EK3_ENABLE", 1),  # without effect
    _int8("FENCE_ACTION", 1),  # this and the other parameters of fences are without effect
    _real("FENCE_ALT_MAX", 100.0),  # m
    _int8("FENCE_ENABLE", 0),
    _real("FENCE_RADIUS", 150.0),  # m
    _int8("FENCE_TYPE", 7),  # bit 0 height, bit 1 circle, bit 2 polygons
    *(_int8(f"FLTMODE{at}", mode) for at, mode in enumerate((7, 9, 6, 3, 5, 0), 1)),  # no effect
    _int8("FLTMODE_CH", 5),  # channel of the mode switch
    _int8("FRAME_CLASS", 1),  # 1 quadrotor
    _int8("FRAME_TYPE", 0),  # 0 plus
    _int8("FS_EKF_ACTION", 1),  # estimator lost: 0 nothing, 1 or 3 LAND, 2 ALT_HOLD
    _real("FS_EKF_THRESH", 0.8),  # variance at which the estimator is lost
    _int8("FS_GCS_ENABLE", 0),  # ground station lost: 0 nothing, 1 RTL, 5 LAND
    _real("FS_GCS_TIMEOUT", 5.0),  # s without heartbeat until the ground station is lost
    _int32("FS_OPTIONS", 16),  # bits: cases in which failsafes do not act
    _int8("FS_THR_ENABLE", 1),  # radio lost: 0 nothing, 1 RTL
    _int32("GUID_OPTIONS", 0),  # bit 3: the thrust field is thrust, not a climb rate
    _real("GUID_TIMEOUT", 3.0),  # s without setpoint until the vehicle levels or stops
    _int16("LAND_ALT_LOW", 1000),  # cm below which it lands with LAND_SPEED
    _int16("LAND_SPEED", 50),  # cm/s near the ground
    _int16("LAND_SPEED_HIGH", 0),  # cm/s higher up, 0 WPNAV_SPEED_DN
    _int32("LOG_BITMASK", 180222),  # without effect: there is no log
    _real("LOIT_SPEED", 1250.0),  # cm/s of stick flight
    _int8("MIS_RESTART", 0),  # AUTO: 0 resumes the mission, 1 restarts it
    _int16("MIS_TOTAL", 0),  # items of the mission
    _int8("MOT_HOVER_LEARN", 2),  # learn the hover thrust: 1 until reboot, 2 saved
    _real("MOT_THST_EXPO", 0.65),  # curvature of thrust over throttle, 0 linear
    _real("MOT_THST_HOVER", 0.39),  # hover thrust, normalised
    _int16("PILOT_SPEED_UP", 250),  # cm/s of stick flight
    _real("PSC_JERK_XY", 5.0),  # m/s^3 across the ground; without effect
    _real("PSC_POSXY_P", 1.0),  # 1/s
    _real("PSC_POSZ_P", 1.0),  # 1/s
    _real("PSC_VELXY_P", 2.0),  # 1/s
    _int32("RTL_ALT", 1500),  # cm above home while returning
    _int16("RTL_ALT_FINAL", 0),  # cm above home where RTL ends, 0 lands
    _real("RTL_CONE_SLOPE", 3.0),  # slope of the cone that limits the height of RTL, 0 off
    _int32("RTL_LOIT_TIME", 5000),  # ms of loiter above home before RTL lands
    _int16("SCHED_LOOP_RATE", 400),  # Hz
    _real("SIM_SPEEDUP", 1.0),  # without effect, see `--speed`
    _int8("SYSID_ENFORCE", 0),  # 1: obey SYSID_MYGCS only
    _int16("SYSID_MYGCS", 255),  # system id of the ground station
    _int16("SYSID_THISMAV", 1),  # system id
    _real("WPNAV_ACCEL", 250.0, 1.0),  # cm/s^2, horizontal
    _real("WPNAV_RADIUS", 200.0, 5.0),  # cm from a waypoint, within which it is reached
    _real("WPNAV_SPEED", 1000.0, 10.0),  # cm/s, horizontal in automatic flight
    _real("WPNAV_SPEED_DN", 150.0),  # cm/s of descent
    _real("WPNAV_SPEED_UP", 250.0),  # cm/s of climb
    _int8("WP_YAW_BEHAVIOR", 2),  # yaw: 0 unchanged, 1 to the waypoint, 2 the same except in RTL
)

_CENTI = 0.01
# `simulator.firmware.px4_tables` explains the roles
ROLES: dict[str, Role] = {
    "stream_timeout_s": "GUID_TIMEOUT",
    "velocity_ratio_most": "FS_EKF_THRESH",  # limit of the failsafe, also for arming; 0: no check
    "disarm_landed_s": 0.45,
    "disarm_idle_s": "DISARM_DELAY",
    "takeoff_height_m": 0.0,  # the command always has a height
    "takeoff_speed_mps": ("WPNAV_SPEED_UP", 0.76 * _CENTI),  # full speed is not reached within 5 m
    "land_speed_mps": ("LAND_SPEED", _CENTI),
    "descent_speed_mps": ("WPNAV_SPEED_DN", _CENTI),
    "cruise_speed_mps": ("WPNAV_SPEED", _CENTI),
    "hover_thrust": "MOT_THST_HOVER",
    "hover_estimated": 0.0,
    "tilt_boost": "ATC_ANGLE_BOOST",
    "ground_station_timeout_s": "FS_GCS_TIMEOUT",
    "ground_station_needed": 0.0,
    "battery_patience_s": "BATT_LOW_TIMER",
    "failsafe_delay_s": 0.0,
    "spool_up_s": 2.5,
    "takeoff_ramp_s": 1.5,
    "ramp_ends_mps": ("WPNAV_SPEED_UP", 0.76 * _CENTI),
    "climbed_within_m": 0.1,
    "thrust_least": 0.0,
    "stick_thrust_least": 0.08,
    "contact_s": 0.3,
    "settled_s": 1.35,
    "slow_below_m": ("LAND_ALT_LOW", _CENTI),
    "fast_above_m": ("LAND_ALT_LOW", 1.1 * _CENTI),
    "crawl_below_m": -1.0,  # never
    "crawl_speed_mps": 0.0,
    "return_descends_to_m": math.inf,
    "reached_m": ("WPNAV_RADIUS", _CENTI),
    "reached_height_m": 1.0,
    "position_without_fix_s": 8.0,
    "return_waits_s": ("RTL_LOIT_TIME", 1e-3),
    "return_settles_s": 1.8,  # before the wait the vehicle brakes and turns
    # position loop: P on position, PID on velocity (acceleration out), and limits
    "position_xy_p": "PSC_POSXY_P",
    "position_z_p": "PSC_POSZ_P",
    "velocity_xy_p": "PSC_VELXY_P",
    "velocity_xy_i": 1.0,
    "velocity_xy_d": 0.25,
    "velocity_z_p": 5.0,
    "velocity_z_i": 10.0,
    "velocity_z_d": 0.0,
    # PSC_ACCZ_IMAX: the integral adds at most 0.8 of full throttle to MOT_THST_HOVER
    "integral_z_max_mps2": lambda parameters: (
        0.8 * GRAVITY_MPS2 / max(parameters["MOT_THST_HOVER"], 1e-3)
    ),
    "speed_xy_mps": ("WPNAV_SPEED", _CENTI),
    "speed_up_mps": 2.5,
    "speed_down_mps": 2.5,
    "tilt_max_rad": lambda parameters: math.radians(parameters["ANGLE_MAX"] * _CENTI),
    "thrust_max": 1.0,
    # automatic flight; the mean braking is lower than the limit, as the jerk is limited
    "turn_radps": lambda parameters: math.radians(parameters["ATC_SLEW_YAW"] * _CENTI),
    "speeding_mps2": ("WPNAV_ACCEL", _CENTI),
    "braking_mps2": ("WPNAV_ACCEL", 0.5 * _CENTI),
    "stopping_mps2": ("WPNAV_ACCEL", _CENTI),
    "stopping_delay_s": 0.4,
    "vertical_mps2": 2.5,
    "facing_mps": lambda parameters: (
        0.05 * (parameters["WPNAV_SPEED"] * _CENTI) if parameters["WP_YAW_BEHAVIOR"] else math.inf
    ),
    # land detector
    "low_thrust_share": 1.0,
    "idle_thrust_share": math.inf,
    "sinking_mps": 0.1,
    "still_down_mps": math.inf,
    "still_across_mps": math.inf,
    "still_radps": math.inf,
    "stick_descent_mps": 2.4,
    "stick_timeout_s": 3.0,  # RC_OVERRIDE_TIME
    "stick_dead_zone_us": 20.0,  # RCx_DZ
    "throttle_dead_zone_us": 100.0,  # THR_DZ
    "stick_expo": 0.0,
    "stick_climb_mps": ("PILOT_SPEED_UP", _CENTI),
    "stick_sink_mps": ("PILOT_SPEED_UP", _CENTI),
    "stick_turn_radps": math.radians(202.5),  # PILOT_Y_RATE
    "stick_speed_mps": ("LOIT_SPEED", _CENTI),
    "stick_acceleration_mps2": 3.57,  # g times tangent of two thirds of ANGLE_MAX
    "stick_braking_mps2": 2.5,  # LOIT_BRK_ACCEL
    "stick_brakes_after_s": 1.0,  # LOIT_BRK_DELAY
    "setpoint_spool_s": 2.8,
    "stream_reaction_s": 0.0,
    "ground_station_stays_s": 0.0,
}


_FAILED = Result.FAILED
_NO_POSITION = warning("Mode change to {mode} failed: requires position")
_NOT_STARTED = warning("Mode change to {mode} failed: init failed")
_NO_TAKEOFF = critical("Auto: Missing Takeoff Cmd")
_HEARTBEAT = ("HEARTBEAT",)
_ORIGIN_AND_HOME = ("GPS_GLOBAL_ORIGIN", "HOME_POSITION")
_ARMING = Rule("arm", do=("arm",), texts=(info("Arming motors"),), send=_ORIGIN_AND_HOME)
_DISARMING = info("Disarming motors")

_UNTIL_REBOOT = ("failsafe", "latch")
_FAILSAFE = {
    "ground station lost": (warning("GCS Failsafe"),),
    "battery low": (
        warning("Battery 1 is low {battery_v:.2f}V used {used_mah:.0f} mAh"),
        warning("Battery Failsafe"),
    ),
    "battery critical": (
        warning("Battery 1 is critical {battery_v:.2f}V used {used_mah:.0f} mAh"),
        warning("Battery Failsafe"),
    ),
}


def _failsafe(
    event: str, parameter: str, modes: Mapping[int, str], do: tuple[str, ...] = ("failsafe",)
) -> Rule:
    """A failsafe without delay: an armed vehicle enters the mode that the parameter selects."""
    to, texts = ByParameter(parameter, modes), _FAILSAFE[event]
    return Rule(event, when=("armed",), to=to, do=do, texts=texts, send=_HEARTBEAT)


# Modes that FS_OPTIONS bit 4 leaves to the pilot
_PILOTED = "STABILIZE ACRO ALT_HOLD LOITER DRIFT POSHOLD BRAKE THROW"
_BATTERY_MODES = {1: "LAND", 2: "RTL", 3: "SMART_RTL", 4: "SMART_RTL", 7: "BRAKE"}
_GROUND_MODES = {**_BATTERY_MODES, 1: "RTL", 5: "LAND"}


def _refusals(event: str, prefix: str, result: Result) -> list[Rule]:
    """Rows that refuse arming (event "arm"), or rows that report what would refuse it, except the
    mode (event "checks", of MAV_CMD_RUN_PREARM_CHECKS)."""

    def refuses(*texts: str, when: tuple[str, ...], mode: str = "*") -> Rule:
        said = tuple(critical(f"{prefix}: {text}") for text in texts)
        return Rule(event, mode, when, result=result, texts=said)

    imu, home = "Accels inconsistent", "AHRS: waiting for home"
    not_aligned = ("Need Alt Estimate", imu, "EKF attitude is bad", home)
    rows = [
        refuses("System not initialised", when=("not reached initialised",)),
        refuses("Internal Errors 0x400", when=("latched thrust not a number",)),
        refuses("Battery failsafe", when=("latched battery low",)),
        refuses("Battery failsafe", when=("latched battery critical",)),
        refuses(*not_aligned, when=("not reached attitude",)),
        refuses("Mode requires mission", when=("mission missing",), mode="AUTO"),
        refuses("{mode} mode not armable", when=("not mode arms",)),
        refuses("Need Position Estimate", home, when=("position missing", "not reached origin")),
        refuses("Need Position Estimate", when=("position missing",)),
        refuses(imu, "Gyros inconsistent", when=("not reached gyros",)),
        refuses("EKF velocity variance", when=("velocity rejected",)),
    ]
    return [row for row in rows if event == "arm" or "not mode arms" not in row.when]


def _fails(event: str, *when: str, texts: tuple[StatusText, ...]) -> Rule:
    """A row that refuses a request."""
    return Rule(event, when=when, result=_FAILED, texts=texts)


RULES = (
    # A mode requested before this event was acknowledged, but is not kept
    Rule("initialised", to="STABILIZE", texts=(info("ArduPilot Ready"),)),
    Rule("origin", send=_ORIGIN_AND_HOME),
    Rule(
        "reminder",
        when=("not armed", "position missing"),
        texts=(critical("PreArm: Need Position Estimate"),),
    ),
    Rule("position", texts=(info("EKF3 IMU0 is using GPS"), info("EKF3 IMU1 is using GPS"))),
    # A heartbeat follows a mode change at once
    Rule("mode", when=("not armed",), to="requested", send=_HEARTBEAT),
    _fails("mode", "position missing", texts=(_NO_POSITION,)),
    _fails("mode", "requests AUTO", "mission missing", texts=(_NOT_STARTED,)),
    _fails(
        "mode", "requests AUTO", "landed", "takeoff item missing", texts=(_NO_TAKEOFF, _NOT_STARTED)
    ),
    _fails("mode", "requests THROW", texts=(_NOT_STARTED,)),
    Rule("mode", to="requested", send=_HEARTBEAT),
    Rule("turn"),
    Rule("home", send=("HOME_POSITION",)),
    Rule("speed", "GUIDED AUTO RTL"),
    Rule("speed", result=_FAILED),
    Rule("servo"),
    _fails("motor test", "not landed", texts=(critical("Motor Test: vehicle not landed"),)),
    _fails("calibration", "armed", texts=(warning("Disarm to allow calibration"),)),
    _fails("compass calibration", "armed", texts=(warning("Disarm to allow compass calibration"),)),
    Rule("loiter", when=("not position missing",), to="LOITER", send=_HEARTBEAT),
    Rule("loiter", result=_FAILED),
    Rule("pause", "GUIDED AUTO", do=("pause",)),
    Rule("continue", "GUIDED AUTO", do=("pause",)),
    _fails("pause", texts=(info("Failed to pause"),)),
    _fails("continue", texts=(info("Failed to resume"),)),
    Rule("mission progress", send=("MISSION_CURRENT",)),
    Rule("item reached", send=("MISSION_ITEM_REACHED",)),
    Rule("mission return", "AUTO", do=("return",)),  # the mode does not change
    Rule("mission finished", when=("landed",), do=("disarm",), texts=(_DISARMING,)),
    Rule("takeoff", "GUIDED", when=("armed", "landed", "climb requested"), do=("take off",)),
    Rule("takeoff", result=_FAILED),
    Rule("climbed", "GUIDED", do=("hold",)),
    Rule("land", to="LAND", send=_HEARTBEAT),
    Rule("return", when=("reached position",), to="RTL", send=_HEARTBEAT),
    _fails("return", texts=(critical("Mode change to RTL failed: requires position"),)),
    Rule("checks", when=("armed",), result=Result.TEMPORARILY_REJECTED),
    *_refusals("checks", "PreArm", Result.ACCEPTED),
    Rule("arm", when=("armed",)),
    *_refusals("arm", "Arm", _FAILED),
    _ARMING,
    Rule("force arm", when=("armed",)),
    Rule("force arm", do=_ARMING.do, texts=_ARMING.texts, send=_ARMING.send),
    Rule("disarm", when=("not armed",)),
    Rule("disarm", when=("landed",), do=("disarm",), texts=(_DISARMING,)),
    Rule("disarm", result=_FAILED),
    Rule("force disarm", when=("not armed",)),
    Rule("force disarm", do=("disarm",), texts=(_DISARMING,)),
    Rule("terminate", when=("not armed",)),
    Rule("terminate", do=("disarm",), texts=(_DISARMING,)),
    # No failsafe and no text: the vehicle levels and keeps its height, or stops; it stays in GUIDED
    Rule("stream lost", when=("attitude setpoint",), do=("level",)),
    Rule("stream lost", when=("velocity setpoint",), do=("hold",)),
    Rule(
        "ground station lost",
        when=("armed", "landed", "not FS_GCS_ENABLE=0"),
        do=("disarm",),
        texts=(_DISARMING, warning("GCS Failsafe - Disarming")),
    ),
    Rule(
        "ground station lost",
        _PILOTED,
        when=("armed", "not FS_GCS_ENABLE=0", "FS_OPTIONS=16"),
        texts=(warning("GCS Failsafe - Continuing Pilot Control"),),
    ),
    _failsafe("ground station lost", "FS_GCS_ENABLE", _GROUND_MODES),
    Rule(  # ArduCopter first looks for a landing sequence in the mission
        "ground station lost",
        when=("armed", "FS_GCS_ENABLE=6"),
        to="RTL",
        do=("failsafe",),
        texts=(
            *_FAILSAFE["ground station lost"],
            warning("Unable to start landing sequence"),
            warning("Mode change to AUTO RTL failed: No return path or landing sequence found"),
            warning("Trying RTL Mode"),
        ),
        send=_HEARTBEAT,
    ),
    Rule(
        "ground station found",
        when=("since ground station lost",),
        do=("recover",),
        texts=(warning("GCS Failsafe Cleared"),),
    ),
    _failsafe("battery low", "BATT_FS_LOW_ACT", _BATTERY_MODES, _UNTIL_REBOOT),
    _failsafe("battery critical", "BATT_FS_CRT_ACT", _BATTERY_MODES, _UNTIL_REBOOT),
    Rule("battery low", texts=(_FAILSAFE["battery low"][0],)),
    Rule("battery critical", texts=(_FAILSAFE["battery critical"][0],)),
    Rule(
        "position lost",
        when=("armed", "not landed", "mode needs position"),
        to=ByParameter("FS_EKF_ACTION", {1: "LAND", 2: "ALT_HOLD", 3: "LAND"}),
        do=("failsafe",),
        texts=(critical("EKF variance"), critical("EKF Failsafe: changed to {mode} Mode")),
        send=_HEARTBEAT,
    ),
    Rule(
        "position found",
        when=("since position lost",),
        do=("recover",),
        texts=(critical("EKF Failsafe Cleared"),),
    ),
    Rule("thrust not a number", do=("latch",)),
    Rule("reboot", when=("not armed",), do=("reboot",)),
    Rule("reboot", result=_FAILED),
    Rule("settled", do=("disarm",), texts=(_DISARMING,)),
    Rule("idle", do=("disarm",), texts=(_DISARMING,)),
)
