"""What ArduCopter sends without being asked, and what it sends on request."""

from __future__ import annotations

from simulator.firmware.base import Result, Streams

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
