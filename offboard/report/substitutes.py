"""Telemetry of logs that `offboard` has not written: what such a log holds instead.

Ground stations often record ATTITUDE and GLOBAL_POSITION_INT without ATTITUDE_QUATERNION and
LOCAL_POSITION_NED, and the setpoint in force only as the vehicle reports it (ATTITUDE_TARGET).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.history import History
from offboard.analysis.sender import Stream, continuous_s
from offboard.analysis.tlog import Tlog
from offboard.model.frames import quaternion_from_euler
from offboard.model.geodesy import Geodetic, position_ned_m

Array = NDArray[np.float64]
_ATTITUDE, _GLOBAL, _TARGET = NAMES = "ATTITUDE", "GLOBAL_POSITION_INT", "ATTITUDE_TARGET"


def completed(flown: History, log: Tlog) -> tuple[History, list[str]]:
    """The history with substitutes for telemetry that it lacks, and a sentence for each thing that
    was replaced or is missing."""
    absent = {
        _ATTITUDE: not len(flown.attitude),
        _GLOBAL: not len(flown.position),
        _TARGET: not len(flown.setpoint),
    }
    streams = {name: Stream(name) for name in NAMES if absent[name]}
    if not streams:
        return flown, []
    for place, entry in enumerate(log):
        if entry.name in streams and (entry.system_id, entry.component_id) == flown.vehicle:
            streams[entry.name].add(entry, place, math.nan)
    anchor_ms = 1e3 * next(
        (rows[0, 0] for rows in (flown.attitude, flown.position) if len(rows)), math.nan
    )

    def rows(name: str, fields: str) -> Array:
        table = streams[name].columns(f"time_boot_ms {fields}")
        table[:, 0] = continuous_s(table[:, 0], anchor_ms)
        return table

    present = {name for name, stream in streams.items() if len(stream)}
    flown = replace(
        flown,
        attitude=_attitude(rows) if _ATTITUDE in present else flown.attitude,
        position=_position(rows) if _GLOBAL in present else flown.position,
        setpoint=_setpoint(rows) if _TARGET in present else flown.setpoint,
    )
    return flown, [_NOTES[name][name in present] for name in streams]


_Rows = Callable[[str, str], Array]


def _attitude(rows: _Rows) -> Array:
    angles = rows(_ATTITUDE, "roll pitch yaw rollspeed pitchspeed yawspeed")
    quaternion = quaternion_from_euler(angles[:, 1], angles[:, 2], angles[:, 3])
    return np.column_stack((angles[:, 0], quaternion, angles[:, 4:]))


def _position(rows: _Rows) -> Array:
    """Relative to the first position. Latitude and longitude in 1e-7 deg, mm, cm/s."""
    given = rows(_GLOBAL, "lat lon alt vx vy vz")
    places = [Geodetic(*place) for place in (given[:, 1:4] / (1e7, 1e7, 1e3)).tolist()]
    positions = [position_ned_m(place, places[0]) for place in places]
    return np.column_stack((given[:, 0], positions, given[:, 4:] / 100.0))


def _setpoint(rows: _Rows) -> Array:
    reported = rows(_TARGET, "q thrust")
    return np.insert(reported, 1, math.nan, axis=1)


# what to say without the message, and with it
_NOTES = {
    _ATTITUDE: (
        "no attitude (ATTITUDE_QUATERNION, ATTITUDE)",
        "no ATTITUDE_QUATERNION: the attitude is that of ATTITUDE",
    ),
    _GLOBAL: (
        "no position (LOCAL_POSITION_NED, GLOBAL_POSITION_INT)",
        "no LOCAL_POSITION_NED: positions are of GLOBAL_POSITION_INT, relative to the first one",
    ),
    _TARGET: (
        "no setpoints (SET_ATTITUDE_TARGET of offboard, ATTITUDE_TARGET)",
        "no setpoints of offboard: the commanded attitude is the vehicle's ATTITUDE_TARGET",
    ),
}
