"""Messages that ArduCopter sends periodically and on request."""

from __future__ import annotations

from simulator.firmware.ardupilot import messages
from simulator.firmware.base import Streams
from simulator.firmware.values import Result
from simulator.mavlink.telemetry import builders_in

COMPANION_RATES_HZ = GROUND_RATES_HZ = {"HEARTBEAT": 1.0, "TIMESYNC": 0.1}

# MAV_DATA_STREAM
_GROUPS = {
    1: ("SCALED_PRESSURE",),
    2: ("SYS_STATUS", "MISSION_CURRENT", "GPS_RAW_INT", "NAV_CONTROLLER_OUTPUT"),
    3: ("RC_CHANNELS",),
    6: ("GLOBAL_POSITION_INT", "LOCAL_POSITION_NED"),
    10: ("ATTITUDE",),
    11: ("VFR_HUD",),
    12: ("SYSTEM_TIME", "BATTERY_STATUS", "EKF_STATUS_REPORT", "VIBRATION"),
}
_NEVER_SENT = frozenset({
    22, 26, 27, 34, 35, 36, 87, 100, 105, 116, 124, 125, 127, 128, 129, 132, 133, 136, 137,
    143, 152, 162, 163, 164, 165, 168, 173, 178, 180, 191, 192, 194, 195, 225, 226, 235, 246,
    259, 260, 262, 269, 271, 277, 280, 281, 285, 286, 295, 301, 373, 376, 9005,
})  # fmt: skip
STREAMS = Streams(
    companion_rates_hz=COMPANION_RATES_HZ,
    ground_rates_hz=GROUND_RATES_HZ,
    messages=builders_in(messages),
    withheld_until={
        "LOCAL_POSITION_NED": "position",
        "GPS_GLOBAL_ORIGIN": "origin",
        "HOME_POSITION": "origin",
    },
    versions={},
    position_grid_steps=1,
    fixed=frozenset({"TIMESYNC"}),
    not_on_request=frozenset({"TIMESYNC"}),
    never_sent=_NEVER_SENT,
    groups={0: tuple(name for names in _GROUPS.values() for name in names), **_GROUPS},
    rate_max_hz=200.0,
    refusal=Result.DENIED,
    refusal_text="No ap_message for mavlink id ({id})",
    too_fast_text="Requested rate for message ID {id} too fast. Increase SCHED_LOOP_RATE",
    request_refusal=Result.FAILED,
)
