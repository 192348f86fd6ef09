"""PX4 1.16 multicopter, as data: here its numbers, in the rooms beside what they are made of.

Measured on PX4 1.16.1 SITL where the wire shows it. Knows no simulator core and no socket.
"""

from __future__ import annotations

import math

from simulator.firmware.base import Firmware, PositionGains, Sensors
from simulator.firmware.px4.modes import MODES, command_mode, heartbeat
from simulator.firmware.px4.parameters import PARAMETERS, ROLES
from simulator.firmware.px4.rules import RULES
from simulator.firmware.px4.setpoints import (
    attitude_setpoint,
    in_local_frame,
    motion_complaint,
    motion_setpoint,
)
from simulator.firmware.px4.streams import COMPANION_RATES_HZ, GROUND_RATES_HZ, STREAMS

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
    streams=STREAMS,
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
