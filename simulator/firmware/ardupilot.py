"""ArduCopter 4.6: how it interprets commands, setpoints, missions and battery levels.

Measured on ArduCopter 4.6.3 SITL where MAVLink shows it. Modes, parameters and the
state table are in `simulator.firmware.ardupilot_tables`, telemetry in
`simulator.firmware.ardupilot_messages`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from simulator.autopilot.firmware import Firmware, Refusal
from simulator.autopilot.state import StateEstimate
from simulator.autopilot.values import (
    NAN3,
    Asked,
    AttitudeSetpoint,
    MissionItem,
    MotionSetpoint,
    ParameterValues,
    Result,
    Triple,
    info,
    warning,
)
from simulator.firmware import ardupilot_messages as telemetry
from simulator.firmware.ardupilot_tables import MODES, PARAMETERS, ROLES, RULES
from simulator.vehicle.conditions import BatteryState

_CUSTOM_MODE_ENABLED = 1
_BY_NUMBER = {mode.custom_mode: mode.name for mode in MODES.values()}
# Modes of ArduCopter that the simulator does not enter, with the end of the refusal's text
_NOT_ENTERED = {
    14: "FLIP failed: init failed",
    15: "AUTOTUNE failed: init failed",
    22: "FLOWHOLD failed: init failed",
    23: "FOLLOW failed: init failed",
    25: "SYSTEMID failed: init failed",
    27: "AUTO RTL failed: No return path or landing sequence found",
    28: "TURTLE failed: init failed",
}
# MAV_CMDs that are accepted without effect in the simulator, and those that fail because their
# devices are missing
_TAKEN = (
    181, 182, 198, 202, 203, 206, 207, 208, 216, 2001, 2520, 2600, 5300, 42001, 42003, 42006, 42425,
    42426, 42428, 42651, 43004,
)  # fmt: skip
_FAILED = (
    84, 184, 188, 189, 204, 205, 211, 218, 500, 601, 1000, 1001, 2000, 2500, 2501, 10001,
    42429, 42600,
)  # fmt: skip
_DENIED = (32, 245, 532, 534, 42700)

_CENTI = 0.01
_RATES_IGNORED, _THRUST_IGNORED, _ATTITUDE_IGNORED = 0b111, 64, 128  # type_mask
_POSITION, _VELOCITY, _ACCELERATION, _FORCE, _YAW, _YAW_RATE = 0o007, 0o070, 0o700, 512, 1024, 2048
_NORM_TOLERANCE = 0.0005
_THRUST_IS_THRUST = 8  # GUID_OPTIONS
_STOP = MotionSetpoint(velocity_ned_mps=(0.0, 0.0, 0.0))
_RATE_LEAD_S = 0.175  # rates that come with an attitude offset it: 0.3 rad/s by 3 degrees
_LOCAL_NED, _LOCAL_OFFSET_NED, _BODY_NED, _BODY_OFFSET_NED = 1, 7, 8, 9  # MAV_FRAME
_OFFSET = frozenset({_LOCAL_OFFSET_NED, _BODY_NED, _BODY_OFFSET_NED})
_BODY = frozenset({_BODY_NED, _BODY_OFFSET_NED})

_UNSUPPORTED_FRAME, _UNSUPPORTED, _INVALID_PARAM1 = 2, 3, 6  # MAV_MISSION_RESULT
_PLACE_FRAMES = frozenset({0, 2, 3, 5, 6, 10, 11})
_ITEM_FRAMES = {2: 0, 5: 0, 6: 3, 11: 10}  # frame of an uploaded item -> of the downloaded one
# MAV_CMDs of items with a place
_PLACES = frozenset({
    16, 17, 18, 19, 21, 22, 31, 82, 84, 85, 94, 179, 188, 189, 191, 195, 201,
})  # fmt: skip
_STORED = {1: frozenset(range(5000, 5005)), 2: frozenset({5100})}  # items of fences, rally points
_YAWED = frozenset({16, 17, 21, 22})  # items whose param4 may be NaN
_ACTS = frozenset({
    20, 30, 83, 92, 93, 112, 114, 115, 177, 178, 181, 182, 183, 184, 193, 194, 197, 202, 203, 205,
    206, 207, 208, 210, 211, 212, 213, 215, 216, 217, 218, 222, 223, 531, 532, 534, 600, 601, 1000,
    2000, 2001, 2500, 2501, 3000, 42600, 42702, 42703,
})  # fmt: skip

_TITLES = {
    16: "WP", 17: "LoitUnlim", 18: "LoitTurns", 19: "LoitTime", 20: "RTL", 21: "Land",
    22: "Takeoff", 31: "LoitAltitude", 82: "SplineWP", 93: "Delay", 112: "CondDelay",
    115: "CondYaw", 178: "ChangeSpeed", 181: "SetRelay", 183: "SetServo", 189: "LandStart",
    195: "SetROILocation", 197: "SetROINone", 201: "SetROI", 203: "DigiCamCtrl",
    205: "MountControl", 206: "SetCamTrigDst", 207: "FenceEnable", 211: "Gripper",
}  # fmt: skip

_RETURN_LEAST_M = 2.0  # RTL_ALT_MIN


class ArduCopter(Firmware):
    """ArduCopter 4.6."""

    def command_mode(self, params: tuple[float, ...]) -> Asked:
        """MAV_CMD_DO_SET_MODE (176): param1 base mode, param2 the mode's number."""
        base, number = (int(p) if math.isfinite(p) else 0 for p in params[:2])
        if not base & _CUSTOM_MODE_ENABLED:
            return Asked(refusal=Result.DENIED)
        text = f"No such mode {number}"
        if number in _NOT_ENTERED:
            text = f"Mode change to {_NOT_ENTERED[number]}"
        return Asked(_BY_NUMBER.get(number, ""), Result.FAILED, warning(text))

    def set_mode(self, base_mode: int, custom_mode: int) -> Asked:
        """SET_MODE: the mode's number is custom_mode."""
        return self.command_mode((base_mode, custom_mode))

    def arm_request(self, param: float) -> Asked:
        """param1 1 arms, 0 disarms, any other value is UNSUPPORTED."""
        if param in (0.0, 1.0):
            return Asked("arm" if param else "disarm")
        return Asked(refusal=Result.UNSUPPORTED)

    def attitude_setpoint(
        self, values: Mapping[str, Any], parameters: ParameterValues
    ) -> AttitudeSetpoint | MotionSetpoint | None:
        """SET_ATTITUDE_TARGET as ArduCopter reads it; None: ignored without an answer.

        A message without thrust, with rates that are not finite, or with a quaternion that does not
        have unit length, is ignored (the real SITL stops at a NaN quaternion; a flight controller
        ignores it). If some of the rates are ignored, but not all, the vehicle stops. A thrust of
        NaN counts as zero or, as a climb rate, as no climb, and latches an internal error.
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
        thrust, climb_mps, event = _vertical(values["thrust"], parameters)
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

    def motion_setpoint(self, values: Mapping[str, Any]) -> MotionSetpoint | None:
        """SET_POSITION_TARGET_LOCAL_NED in MAV_FRAME 1. A vector with one ignored component is
        ignored.

        The vehicle stops if it cannot fly the setpoint: an unknown frame, no demand, a position
        with an acceleration and no velocity, a velocity that is not finite. None (ignored without
        an answer): a force, and other values that are not finite.
        """
        mask = values["type_mask"]

        def given(names: tuple[str, str, str], bits: int) -> Triple:
            if mask & bits:
                return NAN3
            a, b, c = (values[name] for name in names)
            return (a, b, c)

        position = given(("x", "y", "z"), _POSITION)
        velocity = given(("vx", "vy", "vz"), _VELOCITY)
        acceleration = given(("afx", "afy", "afz"), _ACCELERATION)
        if mask & _FORCE and not mask & _ACCELERATION:
            return None
        by_velocity, by_acceleration = not mask & _VELOCITY, not mask & _ACCELERATION
        unflyable = not by_velocity and bool(mask & _POSITION) is not by_acceleration
        if values["coordinate_frame"] != _LOCAL_NED or unflyable:
            return _STOP
        if by_velocity and not all(map(math.isfinite, velocity)):
            return _STOP
        yaw = math.nan if mask & _YAW else values["yaw"]
        yaw_rate = math.nan if mask & _YAW_RATE else values["yaw_rate"]
        numbers = (*position, *velocity, *acceleration)
        if any(map(math.isinf, (*numbers, yaw, yaw_rate))) or all(map(math.isnan, numbers)):
            return None
        along = bool(mask & _YAW and mask & _YAW_RATE)
        return MotionSetpoint(position, velocity, acceleration, yaw, yaw_rate, along)

    def in_local_frame(
        self, values: Mapping[str, Any], estimate: StateEstimate
    ) -> Mapping[str, Any]:
        """Convert offset frames, which are relative to the position, and body frames, which are
        relative to the yaw, too."""
        frame = values["coordinate_frame"]
        if frame not in _OFFSET:
            return values
        turn_rad = estimate.yaw_rad if frame in _BODY else 0.0
        cos_yaw, sin_yaw = math.cos(turn_rad), math.sin(turn_rad)
        local = {**values, "coordinate_frame": _LOCAL_NED, "yaw": turn_rad + values["yaw"]}
        for north, east in (("x", "y"), ("vx", "vy"), ("afx", "afy")):
            local[north] = cos_yaw * values[north] - sin_yaw * values[east]
            local[east] = sin_yaw * values[north] + cos_yaw * values[east]
        for name, here_m in zip("xyz", estimate.position_ned_m, strict=True):
            local[name] += here_m
        return local

    def mission_refusal(self, item: MissionItem, kind: int, *, whole: bool) -> Refusal | None:
        if kind:
            return None if item.command in _STORED[kind] else (_UNSUPPORTED, None)
        for number, value in enumerate(item.params):
            may_be_nan = number == 3 and item.command in _YAWED and math.isnan(value)
            if not (math.isfinite(value) or may_be_nan):
                return _INVALID_PARAM1 + number, None
        if item.command not in _PLACES | _ACTS:
            return _UNSUPPORTED, None
        for number, degrees, most_deg in ((4, item.x * 1e-7, 90.0), (5, item.y * 1e-7, 180.0)):
            if item.command in _PLACES and abs(degrees) > most_deg:
                return _INVALID_PARAM1 + number, None
        if item.command in _PLACES and not (item.frame in _PLACE_FRAMES and math.isfinite(item.z)):
            return _UNSUPPORTED_FRAME, None
        return None

    def takes_sticks_from(self, sender: int, parameters: ParameterValues) -> bool:
        """Only those of the ground station are used."""
        return sender == parameters["SYSID_MYGCS"]

    def obeys_system(self, sender: int, own: int, parameters: ParameterValues) -> bool:
        """Every system; with SYSID_ENFORCE only the ground station and the vehicle itself."""
        return not parameters["SYSID_ENFORCE"] or sender in (own, parameters["SYSID_MYGCS"])

    def battery_level(self, battery: BatteryState, parameters: ParameterValues) -> int:
        """Return 2 (critical), 1 (low) or 0, from voltage and remaining charge; a threshold of 0
        disables its check."""

        def below(kind: str) -> bool:
            left_mah = battery.remaining * parameters["BATT_CAPACITY"]
            by_voltage = battery.voltage_v < parameters[f"BATT_{kind}_VOLT"]
            return by_voltage or left_mah < parameters[f"BATT_{kind}_MAH"]

        return 2 if below("CRT") else int(below("LOW"))

    def return_height_m(self, distance_m: float, parameters: ParameterValues) -> float:
        """Return the height of a return above home, limited by a cone (RTL_CONE_SLOPE)."""
        highest_m, slope = parameters["RTL_ALT"] * 0.01, parameters["RTL_CONE_SLOPE"]
        return min(highest_m, max(distance_m * slope, _RETURN_LEAST_M)) if slope > 0 else highest_m


def _vertical(thrust: float, parameters: ParameterValues) -> tuple[float, float | None, str]:
    """Return thrust, climb rate (None: the field is a thrust), and the event that a NaN raises."""
    by_thrust = int(parameters["GUID_OPTIONS"]) & _THRUST_IS_THRUST
    event = ""
    if math.isnan(thrust):
        thrust, event = 0.0 if by_thrust else 0.5, "thrust not a number"
    thrust = min(1.0, max(-1.0, thrust))
    if by_thrust:
        return max(0.0, thrust), None, event
    up = parameters["WPNAV_SPEED_UP"] if thrust > 0.5 else parameters["WPNAV_SPEED_DN"]
    return 0.0, (max(0.0, thrust) - 0.5) / 0.5 * up * _CENTI, event


ARDUPILOT = ArduCopter(
    name="ardupilot",
    vehicle="arducopter",
    scenario="ardupilot_like",
    mav_autopilot=3,
    version=0x040603FF,  # 4.6.3, release
    capabilities=64495,
    origin=(-35.3632621, 149.1652374, 584.09),
    modes=MODES,
    boot_mode="STABILIZE",
    hold_mode="BRAKE",
    rules=RULES,
    parameters=PARAMETERS,
    parameter_roles=ROLES,
    system_parameter="SYSID_THISMAV",
    force_codes={"arm": 2989.0, "disarm": 21196.0},
    reposition_mode="GUIDED",
    ardupilot_commands=True,
    vertical_speeds=(2.0, 3.0),
    empty_refusal=Result.FAILED,
    command_answers={
        **dict.fromkeys(_TAKEN, Result.ACCEPTED),
        **dict.fromkeys(_FAILED, Result.FAILED),
        **dict.fromkeys(_DENIED, Result.DENIED),
    },
    global_frames=frozenset({0, 3, 5, 6, 10, 11}),
    ardupilot_setpoints=True,
    item_frames={"MISSION_ITEM": _ITEM_FRAMES, "MISSION_ITEM_INT": _ITEM_FRAMES},
    frameless_items=_ACTS,
    mission_text=info("Flight plan received"),
    item_titles=_TITLES,
    companion_rates_hz=telemetry.COMPANION_RATES_HZ,
    ground_rates_hz=telemetry.GROUND_RATES_HZ,
    messages=telemetry,
    ground_station_parameter="SYSID_MYGCS",
    ignored=frozenset({"PING", "SET_GPS_GLOBAL_ORIGIN"}),  # its origin is set already
    withheld_until={
        "LOCAL_POSITION_NED": "position",
        "GPS_GLOBAL_ORIGIN": "origin",
        "HOME_POSITION": "origin",
    },
    estimates_airspeed=True,
    position_grid_steps=1,
    fixed_streams=frozenset({"TIMESYNC"}),
    not_on_request=frozenset({"TIMESYNC"}),
    never_sent=telemetry.NEVER_SENT,
    stream_groups={
        0: tuple(name for names in telemetry.GROUPS.values() for name in names),
        **telemetry.GROUPS,
    },
    rate_max_hz=200.0,
    interval_refusal=Result.DENIED,
    interval_refusal_text="No ap_message for mavlink id ({id})",
    too_fast_text="Requested rate for message ID {id} too fast. Increase SCHED_LOOP_RATE",
    request_refusal=Result.FAILED,
    # RADIO_STATUS, RADIO; on USB, which is not simulated, every message
    accepted_unsigned=frozenset({109, 166}),
    stamps_follow_clock=True,  # GPS time
    boot_events_s={
        "initialised": 2.47,
        "aligning": 5.40,
        "attitude": 5.90,
        "fix": 10.2,
        "origin": 20.02,
        "gyros": 24.0,
        "ready without position": 24.0,
        "reminder": 30.45,
        "position": 41.61,
        "ready": 42.5,
    },
    sensor_bits=(0x5371FC2F, 0x5361FC2F, 0x4771FC2F),
    battery_events=("battery low", "battery critical"),
    place_below_is_descent=True,
    default_sticks_us=(1500, 1500, 1000, 1500, 1800, 1000, 1000, 1800),  # of SITL without RC
)
