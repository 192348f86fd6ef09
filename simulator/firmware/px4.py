"""PX4 1.16 multicopter: how it interprets commands, setpoints, missions and battery levels.

Measured on PX4 1.16.1 SITL where MAVLink shows it, including messages that it should refuse.
Modes, parameters and the state table are in `simulator.firmware.px4_tables`, telemetry in
`simulator.firmware.px4_messages`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from offboard.model.frames import rotation_from_quaternion
from simulator.autopilot.firmware import Firmware, Refusal
from simulator.autopilot.state import StateEstimate
from simulator.autopilot.values import (
    Asked,
    AttitudeSetpoint,
    MissionItem,
    MotionSetpoint,
    ParameterValues,
    Result,
    StatusText,
    Triple,
    critical,
)
from simulator.firmware import px4_messages as telemetry
from simulator.firmware.px4_tables import MODES, PARAMETERS, ROLES, RULES
from simulator.vehicle.conditions import BatteryState

# Modes by PX4_CUSTOM_MAIN_MODE and PX4_CUSTOM_SUB_MODE_AUTO
_BY_NUMBER = {
    (mode.custom_mode >> 16 & 0xFF, mode.custom_mode >> 24): mode.name
    for mode in MODES.values()
    if mode.name != "TERMINATION"
}
_AUTO = 4  # main mode
_CUSTOM_MODE_ENABLED = 1
# Modes by MAV_MODE_FLAG, if only the base mode is requested; the first match counts
_BY_FLAGS = ((4, "AUTO.MISSION"), (64 | 8, "POSCTL"), (64 | 16, "STABILIZED"), (64, "MANUAL"))
_NO_AUTO_MODE = critical("Unsupported auto mode")

# MAV_CMDs that are accepted without effect in the simulator, and those that are not acknowledged
_TAKEN = (80, 187, 191, 195, 196, 197, 201, 245, 519, 525, 528)
_UNANSWERED = (
    1, 93, 203, 204, 205, 206, 214, 220, 242, 243, 260, 310, 420, 500, 521, 530, 531, 532, 1000,
    1001, 2003, 3000, 42600,
)  # fmt: skip

_RATES_IGNORED, _THRUST_IGNORED, _ATTITUDE_IGNORED = 0b011, 64, 128  # type_mask
_YAW_IGNORED, _YAW_RATE_IGNORED = 1024, 2048
_LOCAL_NED, _BODY_NED = 1, 8  # MAV_FRAME

_UNSUPPORTED_FRAME, _UNSUPPORTED = 2, 3  # MAV_MISSION_RESULT
_COMMAND_FRAME = 2  # MAV_FRAME_MISSION: no place
# MAV_FRAME: GLOBAL, GLOBAL_RELATIVE_ALT; both with _INT, in MISSION_ITEM_INT only
_PLACE_FRAMES, _INT_FRAMES = frozenset({0, 3}), frozenset({5, 6})
_INVALID = critical("IGN MISSION_ITEM: Invalid item")
# MAV_CMDs of mission items with a place, and without one
_PLACES = frozenset({16, 17, 19, 21, 22, 31, 80, 84, 85, 195, 201, 4501})
_ACTS = frozenset({
    20, 80, 93, 112, 114, 177, 178, 179, 187, 189, 196, 197, 200, 201, 203, 204, 205, 206, 211, 214,
    260, 530, 532, 534, 1000, 1001, 2000, 2001, 2003, 2500, 2501, 3000, 42600,
})  # fmt: skip

_BATTERY_THRESHOLDS = ("BAT_LOW_THR", "BAT_CRIT_THR", "BAT_EMERGEN_THR")


class Px4(Firmware):
    """PX4 1.16."""

    def command_mode(self, params: tuple[float, ...]) -> Asked:
        """MAV_CMD_DO_SET_MODE (176): param1 base mode, param2 main mode, param3 sub mode of AUTO.

        An unknown main mode, or a base mode without flags, is accepted and changes nothing.
        """
        base, main, sub = (int(p) if math.isfinite(p) else 0 for p in params[:3])
        if not base & _CUSTOM_MODE_ENABLED:
            named = (mode for flags, mode in _BY_FLAGS if base & flags == flags)
            return Asked(next(named, ""), Result.ACCEPTED)
        if main == _AUTO:
            known = _BY_NUMBER.get((main, sub), "")
            return Asked(known, Result.TEMPORARILY_REJECTED, _NO_AUTO_MODE)
        return Asked(_BY_NUMBER.get((main, 0), ""), Result.ACCEPTED)

    def set_mode(self, base_mode: int, custom_mode: int) -> Asked:
        """SET_MODE: main mode in the third byte of custom_mode, sub mode in the fourth."""
        return self.command_mode((base_mode, custom_mode >> 16 & 0xFF, custom_mode >> 24))

    def arm_request(self, param: float) -> Asked:
        """param1 is rounded: 1 arms, 0 disarms; a value that is not finite disarms."""
        number = math.floor(param + 0.5) if math.isfinite(param) else 0
        if number in (0, 1):
            return Asked("arm" if number else "disarm")
        text = f"Unsupported ARM_DISARM param: {param:.3f}"
        return Asked(text=critical(text))

    def attitude_setpoint(
        self, values: Mapping[str, Any], parameters: ParameterValues
    ) -> AttitudeSetpoint | None:
        """SET_ATTITUDE_TARGET as PX4 reads it; None if it demands nothing (type_mask 135).

        Rates are ignored if the roll or the pitch bit of type_mask is set, whatever the yaw bit. A
        thrust that is ignored or NaN is zero. A quaternion may have any length; with a zero or
        invalid one, the vehicle keeps the last attitude.
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
        given = (values[f"body_{axis}_rate"] for axis in ("roll", "pitch", "yaw"))
        p, q, r = (rate if math.isfinite(rate) else 0.0 for rate in given)
        return AttitudeSetpoint(None, (p, q, r), thrust)

    def motion_setpoint(self, values: Mapping[str, Any]) -> MotionSetpoint | None:
        """SET_POSITION_TARGET_LOCAL_NED in MAV_FRAME 1; None if it demands nothing."""
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

    def in_local_frame(
        self, values: Mapping[str, Any], estimate: StateEstimate
    ) -> Mapping[str, Any]:
        """Convert MAV_FRAME_BODY_NED: velocity by the yaw, acceleration by the attitude.

        A position is ignored, and a vector with one ignored component is ignored.
        """
        if values["coordinate_frame"] != _BODY_NED:
            return values
        yaw = estimate.yaw_rad
        forward, right = values["vx"], values["vy"]
        given = (values["afx"], values["afy"], values["afz"])
        finite = all(map(math.isfinite, given))
        turned = rotation_from_quaternion(estimate.attitude) @ given if finite else given
        mask = values["type_mask"] | 0b111
        mask |= 0b111_000 if mask & 0b111_000 else 0
        mask |= 0b111_000_000 if mask & 0b111_000_000 else 0
        return {
            **values,
            "coordinate_frame": _LOCAL_NED,
            "type_mask": mask,
            "vx": math.cos(yaw) * forward - math.sin(yaw) * right,
            "vy": math.sin(yaw) * forward + math.cos(yaw) * right,
            "afx": float(turned[0]),
            "afy": float(turned[1]),
            "afz": float(turned[2]),
        }

    def setpoint_rejection(self, message: str, frame: int | None) -> StatusText:
        """Text about a setpoint in an unknown frame, or (`frame` None) with no demand."""
        if frame is None:
            return critical(f"{message} invalid")
        if message.endswith("GLOBAL_INT"):
            return critical(f"{message} invalid coordinate frame {frame}")
        return critical(f"{message} coordinate frame {frame} unsupported")

    def mission_refusal(self, item: MissionItem, kind: int, *, whole: bool) -> Refusal | None:
        if kind:
            return None
        by_place = item.frame in (_PLACE_FRAMES | _INT_FRAMES if whole else _PLACE_FRAMES)
        if not by_place and item.frame != _COMMAND_FRAME:
            return _UNSUPPORTED_FRAME, _INVALID
        if item.command not in (_PLACES if by_place else _ACTS):
            return _UNSUPPORTED, _INVALID
        if by_place and not math.isfinite(item.z):
            return _UNSUPPORTED_FRAME, _INVALID
        return None

    def takes_sticks_from(self, sender: int, parameters: ParameterValues) -> bool:
        """Those of every system, unless the parameter allows RC or nothing."""
        return parameters["COM_RC_IN_MODE"] in (1, 2, 3)

    def battery_level(self, battery: BatteryState, parameters: ParameterValues) -> int:
        """Return the number of thresholds that the remaining share is below."""
        return sum(battery.remaining < parameters[name] for name in _BATTERY_THRESHOLDS)

    def return_height_m(self, distance_m: float, parameters: ParameterValues) -> float:
        """Return the height of a return above home: near home it is limited by a cone
        (RTL_CONE_ANG)."""
        highest_m, accepted_m = parameters["RTL_RETURN_ALT"], parameters["NAV_ACC_RAD"]
        if distance_m <= accepted_m:
            return min(2.0 * distance_m, highest_m)
        height_m = highest_m
        if distance_m <= parameters["RTL_MIN_DIST"]:
            cone_rad = math.radians(min(89.0, max(1.0, parameters["RTL_CONE_ANG"])))
            height_m = min(distance_m / math.tan(cone_rad), highest_m)
        return min(max(height_m, 2.0 * accepted_m), highest_m)


PX4 = Px4(
    name="px4",
    vehicle="px4_sih",
    scenario="px4_like",
    mav_autopilot=12,
    version=0x011001FF,  # 1.16.1, release
    # float parameters, missions and commands in integers, bytewise parameters, targets of attitude
    # and local position, termination, MAVLink 2, fences, rally points
    capabilities=0xE8DF,  # those of 1.16.1 without FTP
    origin=(47.397742, 8.545594, 489.4),
    modes=MODES,
    boot_mode="AUTO.LOITER",
    hold_mode="AUTO.LOITER",
    rules=RULES,
    parameters=PARAMETERS,
    parameter_roles=ROLES,
    system_parameter="MAV_SYS_ID",
    mode_acked_twice=True,
    set_mode_acked_as=176,
    force_codes={"arm": 21196.0, "disarm": 21196.0},
    reposition_mode="AUTO.LOITER",
    empty_refusal=Result.ACCEPTED,
    no_interval_us=0,
    command_answers={
        **dict.fromkeys(_TAKEN, Result.ACCEPTED),
        **dict.fromkeys(_UNANSWERED),
        189: Result.CANCELLED,
        224: Result.UNSUPPORTED,  # clients use the message MISSION_SET_CURRENT
    },
    global_frames=frozenset({5, 6, 11}),
    requests_kind_of_peer=True,
    item_frames={"MISSION_ITEM": {5: 0, 6: 3}, "MISSION_ITEM_INT": {0: 5, 3: 6}},
    turning_items=frozenset({16, 17, 19, 21}),
    companion_rates_hz=telemetry.COMPANION_RATES_HZ,
    ground_rates_hz=telemetry.GROUND_RATES_HZ,
    messages=telemetry,
    withheld_until={"GLOBAL_POSITION_INT": "fix", "HOME_POSITION": "fix"},
    message_versions=telemetry.VERSIONS,
    position_grid_steps=2,
    fixed_streams=telemetry.ON_EVENT | {"HEARTBEAT"},
    not_on_request=telemetry.ON_EVENT,
    never_sent=telemetry.NEVER_SENT,
    interval_refusal=Result.FAILED,
    request_refusal=Result.DENIED,
    # RC channels have no RC_MAP_*, the others no handler
    ignored=frozenset(
        {"MISSION_WRITE_PARTIAL_LIST", "RC_CHANNELS_OVERRIDE", "AUTOPILOT_VERSION_REQUEST"}
    ),
    target_component_checked=True,
    never_to_all=frozenset({"COMMAND", "MISSION", "PARAM"}),
    text_suffix="\t",
    text_to_ground_stations_only=True,
    px4_parameters=True,
    # those of 1.17, as 1.16 has no signing: HEARTBEAT, RADIO_STATUS, ADSB_VEHICLE, COLLISION
    accepted_unsigned=frozenset({0, 109, 246, 247}),
    # gyro, accelerometer, magnetometer, absolute pressure, GPS; battery, AHRS; the health bits
    # include the geofence, as otherwise MAVProxy reports a breach
    sensor_bits=(0x0300402F, 0x0301402F, 0x0330C83F),
    boot_events_s={"fix": 3.0, "ready": 4.0, "ready without position": 4.0},
    fails_where_unarmable=True,
    battery_events=("battery low", "battery critical", "battery emergency"),
    return_faces_way=True,
    integrates_on_ramp=True,
)
