"""Telemetry of logs that `offboard` has not written: what such a log holds instead.

Ground stations often record ATTITUDE and GLOBAL_POSITION_INT without ATTITUDE_QUATERNION and
LOCAL_POSITION_NED, and the setpoint in force only as the vehicle reports it (ATTITUDE_TARGET).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from offboard.analysis.history import ATTITUDE, POSITION, SETPOINT, History
from offboard.analysis.samples import Rows, Samples, Wire
from offboard.analysis.tlog import Tlog
from offboard.model.frames import quaternion_from_euler
from offboard.model.geodesy import Geodetic, position_ned_m

_WIRES = {  # by the array of History that they replace
    "attitude": Wire(
        "ATTITUDE", {"angles": "roll pitch yaw", "rates": "rollspeed pitchspeed yawspeed"}
    ),
    "position": Wire("GLOBAL_POSITION_INT", {"place": "lat lon alt", "velocity": "vx vy vz"}),
    "setpoint": Wire("ATTITUDE_TARGET", {"quaternion": "q", "thrust": "thrust"}),
}
_DTYPES = {
    "attitude": [("time_s", "f8"), ("angles", "3f8"), ("rates", "3f4")],
    "position": [("time_s", "f8"), ("place", "3f8"), ("velocity", "3f4")],
    "setpoint": SETPOINT,
}


def completed(flown: History, log: Tlog) -> tuple[History, list[str]]:
    """The history with substitutes for telemetry that it lacks, and a sentence for each thing that
    was replaced or is missing."""
    absent = {wire.name: part for part, wire in _WIRES.items() if not len(getattr(flown, part))}
    samples = {part: Samples(_DTYPES[part]) for part in absent.values()}
    if not absent:
        return flown, []
    for entry in log:
        part = absent.get(entry.name)
        if part and (entry.system_id, entry.component_id) == flown.vehicle:
            samples[part].add(_WIRES[part], entry.frame.payload, math.nan, math.nan)
    anchor_ms = 1e3 * next(
        (rows["time_s"][0] for rows in (flown.attitude, flown.position) if len(rows)), math.nan
    )
    found = {part: each.rows(anchor_ms) for part, each in samples.items()}
    notes = [_NOTES[part][len(rows) > 0] for part, rows in found.items()]
    convert = {"attitude": _attitude, "position": _position}
    used: dict[str, Any] = {
        part: convert[part](rows) if part in convert else rows
        for part, rows in found.items()
        if len(rows)
    }
    return replace(flown, **used), notes


def _attitude(given: Rows) -> Rows:
    rows = np.empty(len(given), ATTITUDE)
    rows["time_s"], rows["rates_radps"] = given["time_s"], given["rates"]
    rows["quaternion"] = quaternion_from_euler(*given["angles"].T)
    return rows


def _position(given: Rows) -> Rows:
    """Relative to the first position. Latitude and longitude in 1e-7 deg, mm, cm/s."""
    rows = np.empty(len(given), POSITION)
    places = given["place"] / (1e7, 1e7, 1e3)
    rows["time_s"], rows["velocity_ned_mps"] = given["time_s"], given["velocity"] / 100.0
    rows["position_ned_m"] = position_ned_m(places, Geodetic(*places[0]))
    return rows


# what to say without the message, and with it
_NOTES = {
    "attitude": (
        "no attitude (ATTITUDE_QUATERNION, ATTITUDE)",
        "no ATTITUDE_QUATERNION: the attitude is that of ATTITUDE",
    ),
    "position": (
        "no position (LOCAL_POSITION_NED, GLOBAL_POSITION_INT)",
        "no LOCAL_POSITION_NED: positions are of GLOBAL_POSITION_INT, relative to the first one",
    ),
    "setpoint": (
        "no setpoints (SET_ATTITUDE_TARGET of offboard, ATTITUDE_TARGET)",
        "no setpoints of offboard: the commanded attitude is the vehicle's ATTITUDE_TARGET",
    ),
}
