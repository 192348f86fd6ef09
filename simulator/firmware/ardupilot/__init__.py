"""ArduCopter 4.6, as data: here its numbers, in the rooms beside what they are made of.

Measured on ArduCopter 4.6.3 SITL where the wire shows it. Knows no simulator core and no socket.
"""

from __future__ import annotations

import math

from simulator.battery import BatteryState
from simulator.firmware.ardupilot.messages import MESSAGES
from simulator.firmware.ardupilot.missions import MISSIONS
from simulator.firmware.ardupilot.modes import (
    COMMAND_ANSWERS,
    MODES,
    arm_wish,
    command_mode,
    heartbeat,
    set_mode,
)
from simulator.firmware.ardupilot.parameters import PARAMETERS, ROLES
from simulator.firmware.ardupilot.rules import BOOT, RULES
from simulator.firmware.ardupilot.setpoints import (
    attitude_setpoint,
    in_local_frame,
    motion_setpoint,
)
from simulator.firmware.ardupilot.streams import DEFAULT_RATES_HZ, STREAMS
from simulator.firmware.base import (
    Firmware,
    Heads,
    Landing,
    PositionGains,
    ReadParameter,
    Result,
    Sensors,
)
from simulator.sticks import Handling

RETURN_LEAST_M = 2.0  # RTL_ALT_MIN


def gains(parameter: ReadParameter) -> PositionGains:
    """The position loop as its parameters have it."""
    speed_mps = parameter("WPNAV_SPEED") * 0.01
    return PositionGains(
        position_xy_ps=parameter("PSC_POSXY_P"),
        position_z_ps=parameter("PSC_POSZ_P"),
        velocity_xy=(parameter("PSC_VELXY_P"), 1.0, 0.25),
        velocity_z=(5.0, 10.0, 0.0),
        speed_xy_mps=speed_mps,
        speed_up_mps=2.5,
        speed_down_mps=2.5,
        tilt_max_rad=math.radians(parameter("ANGLE_MAX") * 0.01),
        thrust_max=1.0,
        derivative_cutoff_hz=5.0,
        turn_radps=math.radians(parameter("ATC_SLEW_YAW") * 0.01),
        facing_mps=0.05 * speed_mps if parameter("WP_YAW_BEHAVIOR") else math.inf,
    )


def return_height_m(distance_m: float, parameter: ReadParameter) -> float:
    """Under a cone near home (RTL_CONE_SLOPE), so that a short way needs no high climb."""
    highest_m, slope = parameter("RTL_ALT") * 0.01, parameter("RTL_CONE_SLOPE")
    return min(highest_m, max(distance_m * slope, RETURN_LEAST_M)) if slope > 0 else highest_m


def return_heads(_: float, parameter: ReadParameter) -> Heads | None:
    """As it did, by default."""
    return Heads.ALONG if parameter("WP_YAW_BEHAVIOR") in (1.0, 3.0) else None


def battery_level(battery: BatteryState, parameter: ReadParameter) -> int:
    """By voltage, or by the charge that remains of BATT_CAPACITY; 0 asks for neither."""

    def below(kind: str) -> bool:
        left_mah = battery.remaining * parameter("BATT_CAPACITY")
        by_voltage = battery.voltage_v < parameter(f"BATT_{kind}_VOLT")
        return by_voltage or left_mah < parameter(f"BATT_{kind}_MAH")

    return 2 if below("CRT") else int(below("LOW"))


def is_ground_station(_: int, system: int, parameter: ReadParameter) -> bool:
    """By its system id, whatever it is."""
    return system == parameter("SYSID_MYGCS")


def obeys_system(sender: int, own: int, parameter: ReadParameter) -> bool:
    """All, or its ground station and its own components alone."""
    return not parameter("SYSID_ENFORCE") or sender in (own, parameter("SYSID_MYGCS"))


HANDLING = Handling(
    # throttle down, mode switch and others as SITL has them
    feigned=(1500, 1500, 1000, 1500, 1800, 1000, 1000, 1800),
    climb_mps=2.5,  # PILOT_SPEED_UP
    turn_radps=math.radians(202.5),  # PILOT_Y_RATE
    speed_mps=12.5,  # LOIT_SPEED
    acceleration_mps2=3.57,  # of two thirds of ANGLE_MAX
    braking_mps2=2.5,  # LOIT_BRK_ACCEL
    braking_after_s=1.0,  # LOIT_BRK_DELAY
)

ARDUPILOT = Firmware(
    name="ardupilot",
    vehicle="arducopter",
    scenario="ardupilot_like",
    mav_autopilot=3,
    version=0x040603FF,  # 4.6.3, release
    capabilities=64495,
    origin=(-35.3632621, 149.1652374, 584.09),
    boot_mode="STABILIZE",
    reposition_mode="GUIDED",
    repositions_strictly=True,
    modes=MODES,
    rules=RULES,
    parameters=PARAMETERS,
    parameter_roles=ROLES,
    system_parameter="SYSID_THISMAV",
    parameters_hashed=False,
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
    mission_first=1,
    missions=MISSIONS,
    mode_acked_twice=False,
    text_to_ground_stations_only=False,
    is_ground_station=is_ground_station,
    ground_station_stays_s=0.0,
    obeys_system=obeys_system,
    text_suffix="",
    target_component_checked=False,
    answers_carry_index=False,
    takeoff_above_home=True,
    force_codes={"arm": 2989.0, "disarm": 21196.0},
    healthy_after_s=42.5,
    healthy_without_position_after_s=24.0,
    unhealthy_where_unarmable=False,
    setpoint_mode_needs_stream=False,
    setpoints_as_automatic=True,
    setpoints_outlive_modes=False,
    setpoint_decides_flight=True,
    setpoint_spool_s=2.8,
    stream_reaction_s=0.0,
    descend_speed_mps=2.4,
    handling=HANDLING,
    landing=Landing(
        low_thrust_share=1.0,
        idle_thrust_share=math.inf,
        sinking_mps=0.1,
        speed_down_mps=math.inf,
        speed_across_mps=math.inf,
        rate_radps=math.inf,
        place_below_is_descent=True,
    ),
    gains=gains,
    return_height_m=return_height_m,
    return_heads=return_heads,
    battery_level=battery_level,
    battery_events=("battery low", "battery critical"),
    heartbeat=heartbeat,
    command_mode=command_mode,
    set_mode=set_mode,
    speed_refusal=Result.FAILED,
    set_mode_acked_as=None,
    arm_wish=arm_wish,
    command_answers=COMMAND_ANSWERS,
    attitude_setpoint=attitude_setpoint,
    motion_setpoint=motion_setpoint,
    in_local_frame=in_local_frame,
    position_without_fix_s=8.0,
    global_frames=frozenset({0, 3, 5, 6, 10, 11}),
)
