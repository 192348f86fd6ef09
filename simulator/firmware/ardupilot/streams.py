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
_IDLE = frozenset({
    22, 26, 29, 34, 35, 62, 87, 100, 105, 116, 124, 125, 127, 128, 129, 132, 133, 136, 137,
    143, 152, 162, 163, 165, 168, 173, 178, 180, 191, 192, 194, 195, 225, 226, 235, 241, 246,
    259, 260, 262, 269, 271, 277, 280, 281, 285, 286, 295, 301, 373, 376, 9005,
})  # fmt: skip
STREAMS = Streams(
    fixed=frozenset({"TIMESYNC"}),
    by_itself=frozenset({"TIMESYNC"}),
    idle=_IDLE,
    groups={0: tuple(name for names in _GROUPS.values() for name in names), **_GROUPS},
    rate_max_hz=200.0,
    refusal=Result.DENIED,
    refusal_text="No ap_message for mavlink id ({id})",
    too_fast_text="Requested rate for message ID {id} too fast. Increase SCHED_LOOP_RATE",
    request_refusal=Result.FAILED,
)
