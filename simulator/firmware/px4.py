"""PX4 1.16 multicopter: its modes, rules, texts, numbers, rates and parameters, as data.

Measured on PX4 1.16.1 SITL where the wire shows it. Knows no simulator core and no socket.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from offboard.model.frames import rotation_from_quaternion
from simulator.firmware.base import (
    AT_LAST,
    AttitudeSetpoint,
    Behaviour,
    Condition,
    Firmware,
    Mode,
    ModeRequest,
    MotionSetpoint,
    ParameterSpec,
    PositionGains,
    Quaternion,
    ReadParameter,
    Result,
    Role,
    Rule,
    Say,
    Sensors,
    Severity,
    Streams,
    Triple,
)

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


def _info(text: str) -> Say:
    return Say(Severity.INFO, text)


def _critical(text: str) -> Say:
    return Say(Severity.CRITICAL, text)


_LATER = Result.TEMPORARILY_REJECTED
_LOST = _critical("Failsafe activated")
_NOT_AVAILABLE = _critical("Switching to {mode} is currently not available")

_RTL, _LAND = "AUTO.RTL", "AUTO.LAND"
_REGAINED = _info("GCS connection regained")
_WARNINGS = {
    "battery low": Say(Severity.EMERGENCY, "Low battery"),
    "battery critical": Say(Severity.EMERGENCY, "Critical battery"),
    "battery emergency": Say(Severity.EMERGENCY, "Emergency battery level"),
    "ground station lost": _info("Connection to ground station lost"),
}


def _put_off(event: str, parameter: str, modes: Mapping[int, str]) -> list[Rule]:
    """First hold, so that a pilot can take over; then the mode that the parameter's value names."""
    chosen = [(f"{parameter}={value}", mode) for value, mode in modes.items()]
    return [
        *(
            Rule(
                event,
                when=("armed", "not landed", value),
                to="AUTO.LOITER",
                do=("failsafe", "await"),
                say=_WARNINGS[event],
                also=(_critical("Failsafe activated: entering Hold for {delay_s:.0f} seconds"),),
            )
            for value, _ in chosen
        ),
        *(
            Rule(
                event + AT_LAST,
                when=(f"since {event}", value),
                to=mode,
                do=("failsafe",),
                say=_LOST,
            )
            for value, mode in chosen
        ),
    ]


RULES = (
    Rule("mode", when=("not armed",), to="requested"),
    Rule("mode", when=("mode can run",), to="requested"),
    Rule("mode", result=_LATER, say=_NOT_AVAILABLE),
    Rule("takeoff", to="AUTO.TAKEOFF"),
    Rule("land", to="AUTO.LAND", say=_info("Landing at current position")),
    Rule("return", to="AUTO.RTL", say=_info("Returning to launch")),
    Rule("arm", when=("armed",)),
    Rule("arm", when=("ready",), do=("arm",), say=_info("Armed by external command")),
    Rule(
        "arm", result=_LATER, say=_critical("Arming denied: Resolve system health failures first")
    ),
    Rule("force arm", when=("armed",)),
    Rule("force arm", do=("arm",), say=_info("Armed by external command")),
    Rule("disarm", when=("not armed",)),
    Rule(
        "disarm",
        when=("landed",),
        do=("disarm",),
        to="remembered",
        say=_info("Disarmed by external command"),
    ),
    Rule("disarm", result=_LATER, say=_critical("Disarming denied: not landed")),
    Rule("force disarm", when=("not armed",)),
    Rule(
        "force disarm", do=("disarm",), to="remembered", say=_info("Disarmed by external command")
    ),
    *(
        Rule(
            "stream lost",
            "OFFBOARD",
            when=("armed", f"COM_OBL_RC_ACT={action}"),
            to=fallback,
            do=("failsafe",),
            say=_LOST,
        )
        for action, fallback in enumerate(
            ("POSCTL", "ALTCTL", "STABILIZED", "AUTO.RTL", "AUTO.LAND", "AUTO.LOITER")
        )
    ),
    Rule("stream found", when=("since stream lost",), to="remembered", do=("recover",)),
    *_put_off("battery critical", "COM_LOW_BAT_ACT", {1: _RTL, 2: _LAND, 3: _RTL}),
    *_put_off("battery emergency", "COM_LOW_BAT_ACT", {1: _RTL, 2: _LAND, 3: _LAND}),
    *_put_off("ground station lost", "NAV_DLL_ACT", {1: "AUTO.LOITER", 2: _RTL, 3: _LAND}),
    *(Rule(event, say=said) for event, said in _WARNINGS.items()),
    Rule(
        "ground station found",
        when=("since ground station lost",),
        to="remembered",
        do=("recover",),
        say=_REGAINED,
    ),
    Rule("ground station found", say=_REGAINED),
    Rule("position lost", "OFFBOARD", when=("not obeys motion",)),
    Rule("position lost", when=("armed", "not landed"), to=_LAND, do=("failsafe",), say=_LOST),
    Rule("position found", when=("since position lost",), to="remembered", do=("recover",)),
    Rule("climbed", "AUTO.TAKEOFF", to="AUTO.LOITER"),
    Rule("default height", say=_info("Using default takeoff altitude: {takeoff_m:.1f} m")),
    Rule(
        "return begun",
        say=_info(
            "RTL: start return at {target_amsl_m:.0f} m ({target_m:.0f} m above destination)"
        ),
    ),
    Rule("return lands", say=_info("RTL: land at destination")),
    Rule(
        "mission",
        when=("mission missing",),
        result=Result.DENIED,
        say=_critical("Mission start denied! No valid mission"),
    ),
    Rule("mission", when=("armed",), to="AUTO.MISSION"),
    Rule(
        "mission",
        when=("ready",),
        do=("arm",),
        to="AUTO.MISSION",
        say=_info("Armed by mission start"),
    ),
    Rule(
        "mission", result=_LATER, say=_critical("Switching to Mission is currently not available")
    ),
    Rule(
        "mission climbs",
        say=_info("Executing Mission"),
        also=(_info("Climb to {climb_m:.1f} meters above home"),),
    ),
    Rule("mission progress", send=("MISSION_CURRENT",)),
    Rule("item reached", send=("MISSION_ITEM_REACHED",)),
    Rule("mission return", "AUTO.MISSION", to="AUTO.RTL", say=_info("Returning to launch")),
    Rule("mission finished", say=_info("Mission finished, loitering")),
    Rule("took off", say=_info("Takeoff detected")),
    Rule("landed", say=_info("Landing detected")),
    Rule("settled", do=("disarm",), to="remembered", say=_info("Disarmed by landing")),
    Rule(
        "idle",
        do=("disarm",),
        to="remembered",
        say=_info("Disarmed by auto preflight disarming"),
    ),
)


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

COMPANION_RATES_HZ = {
    "HEARTBEAT": 1.0,
    "ATTITUDE": 100.0,
    "ATTITUDE_QUATERNION": 50.0,
    "GLOBAL_POSITION_INT": 50.0,
    "HIGHRES_IMU": 50.0,
    "LOCAL_POSITION_NED": 30.0,
    "ODOMETRY": 30.0,
    "ALTITUDE": 10.0,
    "ATTITUDE_TARGET": 10.0,
    "POSITION_TARGET_LOCAL_NED": 10.0,
    "TIMESYNC": 10.0,
    "VFR_HUD": 10.0,
    "GPS_RAW_INT": 8.0,
    "SYS_STATUS": 5.0,
    "EXTENDED_SYS_STATE": 5.0,
    "ESTIMATOR_STATUS": 1.0,
    "SYSTEM_TIME": 1.0,
    "MISSION_CURRENT": 1.0,
    "PING": 1.0,
    "BATTERY_STATUS": 0.5,
    "HOME_POSITION": 0.5,
}

GROUND_RATES_HZ = {
    "HEARTBEAT": 1.0,
    "ATTITUDE": 15.0,
    "ATTITUDE_QUATERNION": 10.0,
    "GLOBAL_POSITION_INT": 5.0,
    "GPS_RAW_INT": 5.0,
    "VFR_HUD": 4.0,
    "ATTITUDE_TARGET": 2.0,
    "POSITION_TARGET_LOCAL_NED": 1.5,
    "ALTITUDE": 1.0,
    "LOCAL_POSITION_NED": 1.0,
    "SYS_STATUS": 1.0,
    "EXTENDED_SYS_STATE": 1.0,
    "SYSTEM_TIME": 1.0,
    "MISSION_CURRENT": 1.0,
    "ESTIMATOR_STATUS": 0.5,
    "BATTERY_STATUS": 0.5,
    "HOME_POSITION": 0.5,
    "PING": 0.1,
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


_RATES_IGNORED, _THRUST_IGNORED, _ATTITUDE_IGNORED = 0b011, 64, 128


def attitude_setpoint(values: Mapping[str, Any], _: ReadParameter) -> AttitudeSetpoint | None:
    """SET_ATTITUDE_TARGET, with PX4's lack of checks; None when it is no stream (mask 135).

    Only the roll and pitch rate bits count as "no rates". A thrust that is ignored or NaN is zero
    thrust. A quaternion of any length flies; one without direction leaves the last attitude.
    """
    mask = values["type_mask"]
    attitude_given = not mask & _ATTITUDE_IGNORED
    rates_given = not mask & _RATES_IGNORED
    if not attitude_given and not rates_given:
        return None
    thrust = 0.0 if mask & _THRUST_IGNORED else values["thrust"]
    thrust = min(1.0, max(0.0, thrust)) if not math.isnan(thrust) else 0.0
    if attitude_given:
        w, x, y, z = values["q"]
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        if not (math.isfinite(norm) and norm > 1e-6):
            return AttitudeSetpoint(None, None, thrust)
        return AttitudeSetpoint((w / norm, x / norm, y / norm, z / norm), None, thrust)
    rates = (values["body_roll_rate"], values["body_pitch_rate"], values["body_yaw_rate"])
    finite: Triple = (
        rates[0] if math.isfinite(rates[0]) else 0.0,
        rates[1] if math.isfinite(rates[1]) else 0.0,
        rates[2] if math.isfinite(rates[2]) else 0.0,
    )
    return AttitudeSetpoint(None, finite, thrust)


_LOCAL_NED, _BODY_NED = 1, 8  # MAV_FRAME
_YAW_IGNORED, _YAW_RATE_IGNORED = 1024, 2048


def in_local_frame(values: Mapping[str, Any], attitude: Quaternion) -> Mapping[str, Any]:
    """BODY_NED: velocity turned by the course, acceleration by the attitude, no position.

    A vector is whole or ignored there.
    """
    if values["coordinate_frame"] != _BODY_NED:
        return values
    w, x, y, z = attitude
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    ahead, aside = values["vx"], values["vy"]
    given = (values["afx"], values["afy"], values["afz"])
    finite = all(map(math.isfinite, given))
    turned = rotation_from_quaternion(np.array(attitude)) @ given if finite else given
    mask = values["type_mask"] | 0b111
    mask |= 0b111_000 if mask & 0b111_000 else 0
    mask |= 0b111_000_000 if mask & 0b111_000_000 else 0
    return {
        **values,
        "coordinate_frame": _LOCAL_NED,
        "type_mask": mask,
        "vx": math.cos(yaw) * ahead - math.sin(yaw) * aside,
        "vy": math.sin(yaw) * ahead + math.cos(yaw) * aside,
        "afx": float(turned[0]),
        "afy": float(turned[1]),
        "afz": float(turned[2]),
    }


def motion_complaint(message: str, frame: int | None) -> Say:
    """About a setpoint in an unknown frame; None: one that demands nothing."""
    if frame is None:
        return _critical(f"{message} invalid")
    if message.endswith("GLOBAL_INT"):
        return _critical(f"{message} invalid coordinate frame {frame}")
    return _critical(f"{message} coordinate frame {frame} unsupported")


def motion_setpoint(values: Mapping[str, Any]) -> MotionSetpoint | None:
    """SET_POSITION_TARGET_LOCAL_NED in frame 1; None when nothing is demanded."""
    if values["coordinate_frame"] != _LOCAL_NED:
        return None
    mask = values["type_mask"]

    def triple(names: tuple[str, str, str], shift: int) -> Triple:
        a, b, c = (
            math.nan if mask >> (shift + i) & 1 or math.isinf(values[name]) else values[name]
            for i, name in enumerate(names)
        )
        return (a, b, c)

    position = triple(("x", "y", "z"), 0)
    velocity = triple(("vx", "vy", "vz"), 3)
    acceleration = triple(("afx", "afy", "afz"), 6)
    if all(math.isnan(value) for value in (*position, *velocity, *acceleration)):
        return None
    yaw, yaw_rate = values["yaw"], values["yaw_rate"]
    return MotionSetpoint(
        position,
        velocity,
        acceleration,
        math.nan if mask & _YAW_IGNORED or math.isinf(yaw) else yaw,
        math.nan if mask & _YAW_RATE_IGNORED or math.isinf(yaw_rate) else yaw_rate,
    )


PX4 = Firmware(
    name="px4",
    vehicle="px4_sih",
    scenario="px4_like",
    mav_autopilot=12,
    version=0x011001FF,  # 1.16.1, release
    # float parameters, missions and commands in integers, bytewise parameters, targets of attitude,
    # local and global position, MAVLink 2
    capabilities=0x21DE,
    origin=(47.397742, 8.545594, 489.4),
    boot_mode="AUTO.LOITER",
    modes=MODES,
    rules=RULES,
    parameters=PARAMETERS,
    parameter_roles=ROLES,
    parameters_bytewise=True,
    companion_rates_hz=COMPANION_RATES_HZ,
    ground_rates_hz=GROUND_RATES_HZ,
    streams=Streams(
        fixed=frozenset({"HEARTBEAT"}),
        groups={},
        rate_max_hz=math.inf,
        refusal=Result.FAILED,
        refusal_text="",
        too_fast_text="",
        request_refusal=Result.DENIED,
    ),
    own_messages={},
    unknown_messages=frozenset(),
    withheld_until={},
    # gyro, accelerometer, magnetometer, absolute pressure, GPS; battery, AHRS; health with
    # geofence, or MAVProxy reports a breach
    sensors=Sensors(0x0300402F, 0x0301402F, 0x0330C83F, first_fix_s=3.0),
    position_grid_steps=2,
    boot={},
    mode_acked_twice=True,
    text_to_ground_stations_only=True,
    text_suffix="\t",
    target_component_checked=True,
    answers_carry_index=True,
    takeoff_above_home=False,
    force_codes={"arm": 21196.0, "disarm": 21196.0},
    healthy_after_s=4.0,
    healthy_without_position_after_s=4.0,
    setpoint_mode_needs_stream=True,
    setpoints_outlive_modes=True,
    setpoint_decides_flight=False,
    setpoint_spool_s=0.0,
    stream_reaction_s=0.036,
    descend_speed_mps=0.6,
    spool_up_s=1.0,
    thrust_ramp_s=1.5,
    landed_after_s=1.0,
    climbed_within_m=0.3,
    landing_heights_m=(5.0, 10.0),
    gains=PositionGains(
        position_xy_ps=0.95,
        position_z_ps=1.0,
        velocity_xy=(1.8, 0.4, 0.2),
        velocity_z=(4.0, 2.0, 0.0),
        speed_xy_mps=12.0,
        speed_up_mps=3.0,
        speed_down_mps=1.5,
        tilt_max_rad=math.radians(45.0),
        derivative_cutoff_hz=5.0,
    ),
    heartbeat=heartbeat,
    command_mode=command_mode,
    attitude_setpoint=attitude_setpoint,
    motion_setpoint=motion_setpoint,
    battery_events=(
        ("battery low", "BAT_LOW_THR"),
        ("battery critical", "BAT_CRIT_THR"),
        ("battery emergency", "BAT_EMERGEN_THR"),
    ),
    position_without_fix_s=5.0,  # EKF2_NOAID_TOUT
    in_local_frame=in_local_frame,
    motion_complaint=motion_complaint,
)
