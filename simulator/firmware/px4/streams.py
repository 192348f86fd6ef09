"""What PX4 sends without being asked, and what it sends on request."""

from __future__ import annotations

import math

from simulator.firmware.base import Result, Streams

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

STREAMS = Streams(
    fixed=frozenset({"HEARTBEAT"}),
    groups={},
    rate_max_hz=math.inf,
    refusal=Result.FAILED,
    refusal_text="",
    too_fast_text="",
    request_refusal=Result.DENIED,
)
