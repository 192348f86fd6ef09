"""ArduCopter 4.6 personality: modes, rules, texts, numbers, timeline of the start, as data.

Measured on ArduCopter 4.6.3 SITL where the wire shows it. Knows no simulator core and no socket;
the messages only ArduPilot has are in `ardupilot_messages`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from simulator.firmware.ardupilot_messages import MESSAGES
from simulator.firmware.ardupilot_parameters import PARAMETERS
from simulator.firmware.base import (
    AttitudeSetpoint,
    Behaviour,
    Condition,
    Firmware,
    Mode,
    ModeRequest,
    MotionSetpoint,
    PositionGains,
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

# MAV_MODE_FLAG: 1 custom mode, 8 guided, 16 stabilise, 64 manual input. "Guided" shows whether
# the position controller runs, not the mode.
BY_POSITION, BY_HAND = 89, 81

MODES = {
    mode.name: mode
    for mode in (
        Mode("STABILIZE", "STABILIZE", 0, BY_HAND, Behaviour.LEVEL),
        Mode("ALT_HOLD", "ALT_HOLD", 2, BY_HAND, Behaviour.DESCEND),
        Mode("GUIDED", "GUIDED", 4, BY_POSITION, Behaviour.SETPOINT, needs_position=True),
        Mode("LOITER", "LOITER", 5, BY_POSITION, Behaviour.DESCEND, needs_position=True),
        Mode("RTL", "RTL", 6, BY_POSITION, Behaviour.RETURN, arms=False, needs_position=True),
        Mode("LAND", "LAND", 9, BY_POSITION, Behaviour.LAND, arms=False),
        Mode("BRAKE", "BRAKE", 17, BY_POSITION, Behaviour.HOLD, arms=False, needs_position=True),
        Mode("GUIDED_NOGPS", "GUIDED_NOGPS", 20, BY_HAND, Behaviour.SETPOINT),
    )
}

# Seconds after boot at which an event of this name happens
BOOT = {
    "barometer": 1.94,
    "initialised": 2.47,
    "estimator": 4.45,
    "aligning": 5.40,
    "tilt": 5.80,
    "attitude": 5.90,
    "gps": 9.83,
    "origin": 20.02,
    "gyros": 24.0,
    "reminder": 30.45,
    "position": 41.61,
}


def _info(text: str) -> Say:
    return Say(Severity.INFO, text)


def _critical(text: str) -> Say:
    return Say(Severity.CRITICAL, text)


_FAILED = Result.FAILED
_NO_POSITION = Say(Severity.WARNING, "Mode change to {mode} failed: requires position")
_NEED_POSITION = _critical("Arm: Need Position Estimate")
_HEARTBEAT = ("HEARTBEAT",)
_ORIGIN_AND_HOME = ("GPS_GLOBAL_ORIGIN", "HOME_POSITION")
_ARMING = Rule("arm", do=("arm",), say=_info("Arming motors"), send=_ORIGIN_AND_HOME)
_DISARMING = _info("Disarming motors")

RULES = (
    Rule(
        "barometer",
        say=_info("Barometer 1 calibration complete"),
        also=(_info("Barometer 2 calibration complete"),),
    ),
    # A mode asked for before was acknowledged and is lost
    Rule(
        "initialised",
        to="STABILIZE",
        say=_info("ArduPilot Ready"),
        also=(_info("AHRS: DCM active"),),
    ),
    Rule(
        "estimator",
        say=_info("EKF3 IMU0 initialised"),
        also=(_info("EKF3 IMU1 initialised"), _info("AHRS: EKF3 active")),
    ),
    Rule(
        "tilt",
        say=_info("EKF3 IMU0 tilt alignment complete"),
        also=(_info("EKF3 IMU1 tilt alignment complete"),),
    ),
    Rule(
        "attitude",
        say=_info("EKF3 IMU0 MAG0 initial yaw alignment complete"),
        also=(_info("EKF3 IMU1 MAG0 initial yaw alignment complete"),),
    ),
    Rule(
        "gps",
        say=_info("GPS 1: probing for u-blox at 230400 baud"),
        also=(_info("GPS 1: detected u-blox"),),
    ),
    Rule(
        "origin",
        say=_info("EKF3 IMU0 origin set"),
        also=(_info("Field Elevation Set: 584m"), _info("EKF3 IMU1 origin set")),
        send=_ORIGIN_AND_HOME,
    ),
    Rule(
        "reminder",
        when=("not armed", "position missing"),
        say=_critical("PreArm: Need Position Estimate"),
    ),
    Rule(
        "position",
        say=_info("EKF3 IMU0 is using GPS"),
        also=(_info("EKF3 IMU1 is using GPS"),),
    ),
    # A change of mode is shown by a heartbeat at once
    Rule("mode", when=("not armed",), to="requested", send=_HEARTBEAT),
    Rule("mode", when=("not position missing",), to="requested", send=_HEARTBEAT),
    Rule("mode", result=_FAILED, say=_NO_POSITION),
    Rule("takeoff", "GUIDED", when=("armed", "landed", "climb asked"), do=("take off",)),
    Rule("takeoff", "GUIDED", when=("armed", "climbing", "climb asked"), do=("take off",)),
    Rule("takeoff", result=_FAILED),
    Rule("climbed", "GUIDED", do=("hold",)),
    Rule("land", to="LAND", send=_HEARTBEAT),
    Rule("return", when=("reached position",), to="RTL", send=_HEARTBEAT),
    Rule("return", result=_FAILED, say=_critical("Mode change to RTL failed: requires position")),
    Rule("arm", when=("armed",)),
    Rule(
        "arm",
        when=("not reached initialised",),
        result=_FAILED,
        say=_critical("Arm: System not initialised"),
    ),
    Rule("arm", when=("faulty",), result=_FAILED, say=_critical("Arm: Internal Errors 0x400")),
    Rule(
        "arm",
        when=("not reached attitude",),
        result=_FAILED,
        say=_critical("Arm: Need Alt Estimate"),
        also=(
            _critical("Arm: Accels inconsistent"),
            _critical("Arm: EKF attitude is bad"),
            _critical("Arm: AHRS: waiting for home"),
        ),
    ),
    Rule(
        "arm",
        when=("not mode arms",),
        result=_FAILED,
        say=_critical("Arm: {mode} mode not armable"),
    ),
    Rule(
        "arm",
        when=("position missing", "not reached origin"),
        result=_FAILED,
        say=_NEED_POSITION,
        also=(_critical("Arm: AHRS: waiting for home"),),
    ),
    Rule("arm", when=("position missing",), result=_FAILED, say=_NEED_POSITION),
    Rule(
        "arm",
        when=("not reached gyros",),
        result=_FAILED,
        say=_critical("Arm: Accels inconsistent"),
        also=(_critical("Arm: Gyros inconsistent"),),
    ),
    _ARMING,
    Rule("force arm", when=("armed",)),
    Rule("force arm", do=_ARMING.do, say=_ARMING.say, send=_ARMING.send),
    Rule("disarm", when=("not armed",)),
    Rule("disarm", when=("landed",), do=("disarm",), say=_DISARMING),
    Rule("disarm", result=_FAILED),
    Rule("force disarm", when=("not armed",)),
    Rule("force disarm", do=("disarm",), say=_DISARMING),
    # No failsafe and no text: level, height held, or standing still, and still GUIDED
    Rule("stream lost", when=("obeys attitude",), do=("level",)),
    Rule("stream lost", when=("obeys motion",), do=("hold",)),
    Rule("thrust not a number", do=("latch",)),
    Rule("settled", do=("disarm",), say=_DISARMING),
    Rule("idle", do=("disarm",), say=_DISARMING),
)

_CENTI = 0.01
ROLES: dict[str, Role] = {
    "stream_timeout_s": "GUID_TIMEOUT",
    "disarm_landed_s": 0.45,
    "disarm_idle_s": "DISARM_DELAY",
    "takeoff_height_m": 0.0,  # the command always tells
    "takeoff_speed_mps": ("WPNAV_SPEED_UP", 0.7 * _CENTI),  # 5 m are too few to reach it
    "land_speed_mps": ("LAND_SPEED", _CENTI),
    "descent_speed_mps": ("WPNAV_SPEED_DN", _CENTI),
    "cruise_speed_mps": ("WPNAV_SPEED", _CENTI),
    "return_height_m": ("RTL_ALT", _CENTI),
    "hover_thrust": "MOT_THST_HOVER",
    "tilt_boost": "ATC_ANGLE_BOOST",
    "ground_station_timeout_s": math.inf,
    "failsafe_delay_s": 0.0,
}

DEFAULT_RATES_HZ = {"HEARTBEAT": 1.0, "TIMESYNC": 0.1}

# MAV_DATA_STREAM
_GROUPS = {
    1: ("RAW_IMU",),
    2: ("SYS_STATUS", "GPS_RAW_INT", "EXTENDED_SYS_STATE"),
    3: ("SERVO_OUTPUT_RAW", "RC_CHANNELS"),
    6: ("GLOBAL_POSITION_INT", "LOCAL_POSITION_NED"),
    10: ("ATTITUDE", "SIMSTATE"),
    11: ("VFR_HUD",),
    12: ("SYSTEM_TIME", "BATTERY_STATUS", "EKF_STATUS_REPORT"),
}
STREAMS = Streams(
    fixed=frozenset({"TIMESYNC"}),
    groups={0: tuple(name for names in _GROUPS.values() for name in names), **_GROUPS},
    rate_max_hz=200.0,
    refusal=Result.DENIED,
    refusal_text="No ap_message for mavlink id ({id})",
    too_fast_text="Requested rate for message ID {id} too fast. Increase SCHED_LOOP_RATE",
    request_refusal=Result.FAILED,
)


def heartbeat(now: Condition) -> tuple[int, int]:
    """base_mode and MAV_STATE: 1 booting, 3 on the ground, 4 in the air, 5 in trouble."""
    if "initialised" not in now.reached:
        return BY_POSITION, 1
    base_mode = BY_HAND if isinstance(now.setpoint, AttitudeSetpoint) else now.mode.base_mode
    if now.faulty or now.failsafe:
        return base_mode, 5
    return base_mode, 4 if now.armed and not now.landed else 3


_CUSTOM_MODE_ENABLED = 1
_BY_NUMBER = {mode.custom_mode: mode.name for mode in MODES.values()}


def command_mode(params: tuple[float, ...]) -> ModeRequest:
    """MAV_CMD_DO_SET_MODE (176): param1 base mode, param2 the mode's number."""
    base, number = (int(p) if math.isfinite(p) else 0 for p in params[:2])
    if not base & _CUSTOM_MODE_ENABLED:
        return ModeRequest(None, Result.DENIED)
    known = _BY_NUMBER.get(number)
    unknown = None if known else Say(Severity.WARNING, f"No such mode {number}")
    return ModeRequest(known, Result.FAILED, unknown)


_RATES_IGNORED, _THRUST_IGNORED, _ATTITUDE_IGNORED = 0b111, 64, 128
_NORM_TOLERANCE = 0.0005
_THRUST_IS_THRUST = 8  # GUID_OPTIONS
_STOP = MotionSetpoint(velocity_ned_mps=(0.0, 0.0, 0.0))
# Beside an attitude, rates of .3 rad/s move the equilibrium by 3 degrees
_RATE_LEAD_S = 0.175


def attitude_setpoint(
    values: Mapping[str, Any], parameter: ReadParameter
) -> AttitudeSetpoint | MotionSetpoint | None:
    """SET_ATTITUDE_TARGET. None: dropped in silence, and what was demanded before goes on.

    Dropped: thrust to be ignored, a quaternion off unit length. Rates of which some are to be
    ignored make the vehicle hold its position. A thrust that is not a number is none, and latches
    an internal error (the real SITL stops at a quaternion that is not a number; a board drops it).
    """
    mask = values["type_mask"]
    ignored = mask & _RATES_IGNORED
    if mask & _THRUST_IGNORED:
        return None
    if ignored not in (0, _RATES_IGNORED):
        return _STOP
    given = (values["body_roll_rate"], values["body_pitch_rate"], values["body_yaw_rate"])
    rates: Triple = (0.0, 0.0, 0.0) if ignored else given
    if not all(map(math.isfinite, rates)):
        return None
    thrust, climb_mps, event = _vertical(values["thrust"], parameter)
    if mask & _ATTITUDE_IGNORED:
        return AttitudeSetpoint(None, rates, thrust, climb_mps, event)
    w, x, y, z = values["q"]
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not abs(norm - 1.0) <= _NORM_TOLERANCE:
        return None
    p, q, r = (0.5 * _RATE_LEAD_S * rate for rate in rates)
    ahead = (
        w - x * p - y * q - z * r,
        x + w * p + y * r - z * q,
        y + w * q + z * p - x * r,
        z + w * r + x * q - y * p,
    )
    return AttitudeSetpoint(ahead, None, thrust, climb_mps, event)


def _vertical(thrust: float, parameter: ReadParameter) -> tuple[float, float | None, str]:
    """Thrust, climb rate (None: the thrust is one) and the event of a value that is no number."""
    by_thrust = int(parameter("GUID_OPTIONS")) & _THRUST_IS_THRUST
    event = ""
    if math.isnan(thrust):
        thrust, event = 0.0 if by_thrust else 0.5, "thrust not a number"
    thrust = min(1.0, max(-1.0, thrust))
    if by_thrust:
        return max(0.0, thrust), None, event
    up = parameter("WPNAV_SPEED_UP") if thrust > 0.5 else parameter("WPNAV_SPEED_DN")
    return 0.0, (max(0.0, thrust) - 0.5) / 0.5 * up * _CENTI, event


_LOCAL_NED = 1  # MAV_FRAME
_POSITION, _VELOCITY, _ACCELERATION, _YAW, _YAW_RATE = 0o007, 0o070, 0o700, 1024, 2048
_NOTHING: Triple = (math.nan, math.nan, math.nan)


def motion_setpoint(values: Mapping[str, Any]) -> MotionSetpoint | None:
    """SET_POSITION_TARGET_LOCAL_NED in frame 1: each vector wholly given or ignored."""
    if values["coordinate_frame"] != _LOCAL_NED:
        return None
    mask = values["type_mask"]

    def given(names: tuple[str, str, str], bits: int) -> Triple:
        if mask & bits:
            return _NOTHING
        a, b, c = (values[name] for name in names)
        return (a, b, c)

    position = given(("x", "y", "z"), _POSITION)
    velocity = given(("vx", "vy", "vz"), _VELOCITY)
    acceleration = given(("afx", "afy", "afz"), _ACCELERATION)
    yaw = math.nan if mask & _YAW else values["yaw"]
    yaw_rate = math.nan if mask & _YAW_RATE else values["yaw_rate"]
    numbers = (*position, *velocity, *acceleration)
    if any(map(math.isinf, (*numbers, yaw, yaw_rate))) or all(map(math.isnan, numbers)):
        return None
    return MotionSetpoint(position, velocity, acceleration, yaw, yaw_rate)


ARDUPILOT = Firmware(
    name="ardupilot",
    vehicle="arducopter",
    scenario="ardupilot_like",
    mav_autopilot=3,
    version=0x040603FF,  # 4.6.3, release
    capabilities=64495,
    origin=(-35.3632621, 149.1652374, 584.09),
    boot_mode="STABILIZE",
    modes=MODES,
    rules=RULES,
    parameters=PARAMETERS,
    parameter_roles=ROLES,
    parameters_bytewise=False,
    companion_rates_hz=DEFAULT_RATES_HZ,
    ground_rates_hz=DEFAULT_RATES_HZ,
    streams=STREAMS,
    own_messages=MESSAGES,
    unknown_messages=frozenset(
        {"ODOMETRY", "ESTIMATOR_STATUS", "HIL_STATE_QUATERNION", "ALTITUDE", "HIGHRES_IMU", "PING"}
    ),
    withheld_until={
        "LOCAL_POSITION_NED": "position",
        "GPS_GLOBAL_ORIGIN": "origin",
        "HOME_POSITION": "origin",
    },
    sensors=Sensors(0x5371FC2F, 0x5361FC2F, 0x4771FC2F, first_fix_s=10.2),
    position_grid_steps=1,
    boot=BOOT,
    mode_acked_twice=False,
    text_to_ground_stations_only=False,
    text_suffix="",
    target_component_checked=False,
    answers_carry_index=False,
    takeoff_above_home=True,
    force_codes={"arm": 2989.0, "disarm": 21196.0},
    healthy_after_s=42.5,
    healthy_without_position_after_s=24.0,
    setpoint_mode_needs_stream=False,
    setpoints_outlive_modes=False,
    setpoint_decides_flight=True,
    setpoint_spool_s=2.8,
    stream_reaction_s=0.0,
    descend_speed_mps=2.4,  # LOITER with the throttle stick down
    spool_up_s=2.5,
    thrust_ramp_s=1.7,
    landed_after_s=1.65,
    climbed_within_m=0.1,
    landing_heights_m=(10.0, 11.0),
    gains=PositionGains(
        position_xy_ps=1.0,
        position_z_ps=1.0,
        velocity_xy=(2.0, 1.0, 0.25),
        velocity_z=(5.0, 10.0, 0.0),
        speed_xy_mps=10.0,
        speed_up_mps=2.5,
        speed_down_mps=2.5,
        tilt_max_rad=math.radians(30.0),
        derivative_cutoff_hz=5.0,
    ),
    heartbeat=heartbeat,
    command_mode=command_mode,
    attitude_setpoint=attitude_setpoint,
    motion_setpoint=motion_setpoint,
)
