"""PX4 1.16 multicopter, as data: here its numbers, in the rooms beside what they are made of.

Measured on PX4 1.16.1 SITL where the wire shows it. Knows no simulator core and no socket.
"""

from __future__ import annotations

import math

from simulator.battery import BatteryState
from simulator.firmware.base import (
    Firmware,
    Heads,
    Landing,
    PositionGains,
    ReadParameter,
    Result,
    Sensors,
)
from simulator.firmware.px4.missions import MISSIONS
from simulator.firmware.px4.modes import (
    COMMAND_ANSWERS,
    MODES,
    arm_wish,
    command_mode,
    heartbeat,
    set_mode,
)
from simulator.firmware.px4.parameters import PARAMETERS, ROLES
from simulator.firmware.px4.rules import RULES
from simulator.firmware.px4.setpoints import (
    attitude_setpoint,
    in_local_frame,
    motion_complaint,
    motion_setpoint,
)
from simulator.firmware.px4.streams import COMPANION_RATES_HZ, GROUND_RATES_HZ, STREAMS


def gains(parameter: ReadParameter) -> PositionGains:
    """The position loop as its parameters have it."""
    across = tuple(parameter(f"MPC_XY_VEL_{term}_ACC") for term in "PID")
    up = tuple(parameter(f"MPC_Z_VEL_{term}_ACC") for term in "PID")
    return PositionGains(
        position_xy_ps=parameter("MPC_XY_P"),
        position_z_ps=parameter("MPC_Z_P"),
        velocity_xy=(across[0], across[1], across[2]),
        velocity_z=(up[0], up[1], up[2]),
        speed_xy_mps=parameter("MPC_XY_VEL_MAX"),
        speed_up_mps=parameter("MPC_Z_VEL_MAX_UP"),
        speed_down_mps=parameter("MPC_Z_VEL_MAX_DN"),
        tilt_max_rad=math.radians(parameter("MPC_TILTMAX_AIR")),
        thrust_max=parameter("MPC_THR_MAX"),
        derivative_cutoff_hz=5.0,
        turn_radps=math.radians(parameter("MPC_YAWRAUTO_MAX")),
        facing_mps=parameter("MPC_XY_P") * parameter("NAV_ACC_RAD"),  # further away than that
    )


def return_height_m(distance_m: float, parameter: ReadParameter) -> float:
    """Under a cone near home, so that it comes down there and not beside it."""
    highest_m, accepted_m = parameter("RTL_RETURN_ALT"), parameter("NAV_ACC_RAD")
    if distance_m <= accepted_m:
        return min(2.0 * distance_m, highest_m)
    height_m = highest_m
    if distance_m <= parameter("RTL_MIN_DIST"):
        cone_rad = math.radians(min(89.0, max(1.0, parameter("RTL_CONE_ANG"))))
        height_m = min(distance_m / math.tan(cone_rad), highest_m)
    return min(max(height_m, 2.0 * accepted_m), highest_m)


def return_heads(distance_m: float, parameter: ReadParameter) -> Heads:
    """Far away the way home, near it as it stood there."""
    return Heads.AS_HOME if distance_m < parameter("RTL_MIN_DIST") else Heads.ALONG


_BATTERY_THRESHOLDS = ("BAT_LOW_THR", "BAT_CRIT_THR", "BAT_EMERGEN_THR")
_MAV_TYPE_GCS = 6


def battery_level(battery: BatteryState, parameter: ReadParameter) -> int:
    """By the share that remains."""
    return sum(battery.remaining < parameter(name) for name in _BATTERY_THRESHOLDS)


def is_ground_station(kind: int, _: int, __: ReadParameter) -> bool:
    """By its type, whoever it is."""
    return kind == _MAV_TYPE_GCS


def obeys_system(_: int, __: int, ___: ReadParameter) -> bool:
    """Everybody."""
    return True


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
    reposition_mode="AUTO.LOITER",
    repositions_strictly=False,
    modes=MODES,
    rules=RULES,
    parameters=PARAMETERS,
    parameter_roles=ROLES,
    system_parameter="MAV_SYS_ID",
    parameters_hashed=True,
    parameters_bytewise=True,
    companion_rates_hz=COMPANION_RATES_HZ,
    ground_rates_hz=GROUND_RATES_HZ,
    streams=STREAMS,
    own_messages={},
    unknown_messages=frozenset(),
    withheld_until={},
    # gyro, accelerometer, magnetometer, absolute pressure, GPS; battery, AHRS; health with
    # geofence, or MAVProxy reports a breach
    sensors=Sensors(0x0300402F, 0x0301402F, 0x0330C83F, first_fix_s=3.0),
    position_grid_steps=2,
    boot={},
    mission_first=0,
    missions=MISSIONS,
    mode_acked_twice=True,
    text_to_ground_stations_only=True,
    is_ground_station=is_ground_station,
    ground_station_stays_s=2.5,
    obeys_system=obeys_system,
    text_suffix="\t",
    target_component_checked=True,
    answers_carry_index=True,
    takeoff_above_home=False,
    force_codes={"arm": 21196.0, "disarm": 21196.0},
    healthy_after_s=4.0,
    healthy_without_position_after_s=4.0,
    unhealthy_where_unarmable=True,
    setpoint_mode_needs_stream=True,
    setpoints_as_automatic=False,
    setpoints_outlive_modes=True,
    setpoint_decides_flight=False,
    setpoint_spool_s=0.0,
    stream_reaction_s=0.036,
    descend_speed_mps=0.6,
    handling=None,
    landing=Landing(
        low_thrust_share=0.95,  # of estimates that wander on the ground, too
        idle_thrust_share=0.1,
        sinking_mps=0.09,
        speed_down_mps=0.2,
        speed_across_mps=1.5,  # LNDMC_XY_VEL_MAX
        rate_radps=math.radians(20.0),  # LNDMC_ROT_MAX
        place_below_is_descent=False,
    ),
    gains=gains,
    return_height_m=return_height_m,
    return_heads=return_heads,
    heartbeat=heartbeat,
    command_mode=command_mode,
    set_mode=set_mode,
    speed_refusal=Result.ACCEPTED,
    set_mode_acked_as=176,
    arm_wish=arm_wish,
    command_answers=COMMAND_ANSWERS,
    attitude_setpoint=attitude_setpoint,
    motion_setpoint=motion_setpoint,
    global_frames=frozenset({5, 6, 11}),
    battery_level=battery_level,
    battery_events=("battery low", "battery critical", "battery emergency"),
    position_without_fix_s=5.0,  # EKF2_NOAID_TOUT
    in_local_frame=in_local_frame,
    motion_complaint=motion_complaint,
)
