"""Automatic flight of ArduCopter, from its parameters."""

from __future__ import annotations

import math

from simulator.firmware.base import FlightRules, Landing, PositionGains, StickFlight
from simulator.firmware.values import ReadParameter, ReturnYaw

_RETURN_LEAST_M = 2.0  # RTL_ALT_MIN


def gains(parameter: ReadParameter) -> PositionGains:
    """Gains and limits of the position loop."""
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
        speeding_mps2=parameter("WPNAV_ACCEL") * 0.01,
        braking_mps2=0.5 * parameter("WPNAV_ACCEL") * 0.01,  # as the jerk is limited
        vertical_mps2=2.5,
        facing_mps=0.05 * speed_mps if parameter("WP_YAW_BEHAVIOR") else math.inf,
    )


def return_height_m(distance_m: float, parameter: ReadParameter) -> float:
    """Height of a return above home: under a cone near home (RTL_CONE_SLOPE)."""
    highest_m, slope = parameter("RTL_ALT") * 0.01, parameter("RTL_CONE_SLOPE")
    return min(highest_m, max(distance_m * slope, _RETURN_LEAST_M)) if slope > 0 else highest_m


def return_yaw(_: float, parameter: ReadParameter) -> ReturnYaw | None:
    """Unchanged by default."""
    return ReturnYaw.ALONG_PATH if parameter("WP_YAW_BEHAVIOR") in (1.0, 3.0) else None


_STICKS = StickFlight(
    # throttle down; mode switch and other channels as SITL has them
    default_pulses_us=(1500, 1500, 1000, 1500, 1800, 1000, 1000, 1800),
    climb_mps=2.5,  # PILOT_SPEED_UP
    turn_radps=math.radians(202.5),  # PILOT_Y_RATE
    speed_mps=12.5,  # LOIT_SPEED
    acceleration_mps2=3.57,  # of two thirds of ANGLE_MAX
    braking_mps2=2.5,  # LOIT_BRK_ACCEL
    braking_after_s=1.0,  # LOIT_BRK_DELAY
)


FLIGHT = FlightRules(
    gains=gains,
    integrates_on_ramp=False,
    landing=Landing(
        low_thrust_share=1.0,
        idle_thrust_share=math.inf,
        sinking_mps=0.1,
        speed_down_mps=math.inf,
        speed_across_mps=math.inf,
        rate_radps=math.inf,
        place_below_is_descent=True,
    ),
    descend_speed_mps=2.4,
    sticks=_STICKS,
    return_height_m=return_height_m,
    return_yaw=return_yaw,
)
