"""Messages that PX4 sends periodically and on request."""

from __future__ import annotations

import math
from collections.abc import Hashable

from simulator.firmware.base import Streams
from simulator.firmware.px4 import messages
from simulator.firmware.values import Result
from simulator.mavlink.telemetry import builders_in
from simulator.mavlink.view import View

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
    "SCALED_PRESSURE": 1.0,
    "BATTERY_STATUS": 0.5,
    "CURRENT_MODE": 0.5,
    "HOME_POSITION": 0.5,
    "VIBRATION": 0.5,
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
    "CURRENT_MODE": 0.5,
    "HOME_POSITION": 0.5,
    "PING": 0.1,
}

_STATUS_STEPS = 125  # 0.5 s


def _vehicle_status(view: View) -> Hashable:
    """Version of the topic vehicle_status: new twice a second, and at once when it changes."""
    commander, state = view.autopilot.commander, view.autopilot.state
    modes = (commander.mode, commander.intended)
    return (state.steps // _STATUS_STEPS, modes, commander.armed, commander.failsafe)


_ON_EVENT = frozenset({"MISSION_CURRENT", "MISSION_ITEM_REACHED"})
_NEVER_SENT = frozenset({
    8, 25, 26, 36, 62, 65, 69, 76, 87, 93, 106, 112, 116, 124, 129, 132, 137, 143, 149,
    192, 225, 231, 233, 235, 246, 250, 251, 253, 254, 261, 263, 264, 265, 280, 281, 283,
    284, 285, 286, 290, 291, 300, 330, 339, 350, 360, 361, 371, 372, 375, 380, 395, 397, 435,
    12900, 12901, 12904, 12918, 12920,
})  # fmt: skip
STREAMS = Streams(
    companion_rates_hz=COMPANION_RATES_HZ,
    ground_rates_hz=GROUND_RATES_HZ,
    messages=builders_in(messages),
    withheld_until={},
    versions={"CURRENT_MODE": _vehicle_status},
    position_grid_steps=2,
    fixed=_ON_EVENT | {"HEARTBEAT"},
    not_on_request=_ON_EVENT,
    never_sent=_NEVER_SENT,
    groups={},
    rate_max_hz=math.inf,
    refusal=Result.FAILED,
    refusal_text="",
    too_fast_text="",
    request_refusal=Result.DENIED,
)
