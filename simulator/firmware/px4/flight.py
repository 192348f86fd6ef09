"""Automatic flight of PX4, from its parameters."""

from __future__ import annotations

import math

from simulator.firmware.base import FlightRules, Landing, PositionGains
from simulator.firmware.values import ReadParameter, ReturnYaw


def gains(parameter: ReadParameter) -> PositionGains:
    """Gains and limits of the position loop."""
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
        # jerk is limited in the real one (MPC_JERK_AUTO), which lowers both on average
        speeding_mps2=0.7 * parameter("MPC_ACC_HOR"),
        braking_mps2=0.5 * parameter("MPC_ACC_HOR"),
        vertical_mps2=0.5 * parameter("MPC_ACC_DOWN_MAX"),
        facing_mps=parameter("MPC_XY_P") * parameter("NAV_ACC_RAD"),
    )


def return_height_m(distance_m: float, parameter: ReadParameter) -> float:
    """Height of a return above home: under a cone near home (RTL_CONE_ANG)."""
    highest_m, accepted_m = parameter("RTL_RETURN_ALT"), parameter("NAV_ACC_RAD")
    if distance_m <= accepted_m:
        return min(2.0 * distance_m, highest_m)
    height_m = highest_m
    if distance_m <= parameter("RTL_MIN_DIST"):
        cone_rad = math.radians(min(89.0, max(1.0, parameter("RTL_CONE_ANG"))))
        height_m = min(distance_m / math.tan(cone_rad), highest_m)
    return min(max(height_m, 2.0 * accepted_m), highest_m)


def return_yaw(distance_m: float, parameter: ReadParameter) -> ReturnYaw:
    """Far away in the direction of flight, near home as at home."""
    return ReturnYaw.AS_AT_HOME if distance_m < parameter("RTL_MIN_DIST") else ReturnYaw.ALONG_PATH


FLIGHT = FlightRules(
    gains=gains,
    integrates_on_ramp=True,
    landing=Landing(
        low_thrust_share=0.95,  # of estimates that wander on the ground, too
        idle_thrust_share=0.1,
        sinking_mps=0.09,
        speed_down_mps=0.2,
        speed_across_mps=1.5,  # LNDMC_XY_VEL_MAX
        rate_radps=math.radians(20.0),  # LNDMC_ROT_MAX
        place_below_is_descent=False,
    ),
    descend_speed_mps=0.6,
    sticks=None,
    return_height_m=return_height_m,
    return_yaw=return_yaw,
)
