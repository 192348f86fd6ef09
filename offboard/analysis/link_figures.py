"""Figures of the link: rates, gaps and repetitions of telemetry, gaps of setpoints, delays.

From the arrays of a History to figures of a Score, all in vehicle time as in the flight itself.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.history import History

Array = NDArray[np.float64]


def each_once(rows: Array) -> Array:
    """Rows (N, columns) sorted by time (the first column), the first one of equal times."""
    _, first = np.unique(rows[:, 0], return_index=True)
    once: Array = rows[first]
    return once


def telemetry(history: History, begin_s: float, end_s: float) -> dict[str, float]:
    """Figures of the telemetry between two vehicle times, both included."""
    position, attitude = (
        rows[(rows[:, 0] >= begin_s) & (rows[:, 0] <= end_s)]
        for rows in (history.position, history.attitude)
    )
    newest = np.maximum.accumulate(position[:, 0])
    return {
        "position_hz": _hz(each_once(position)),
        "attitude_hz": _hz(each_once(attitude)),
        "position_gap_max_s": float(np.diff(newest).max(initial=0.0)),
        "stale_share": float(np.mean(position[1:, 0] <= newest[:-1])),
    }


def setpoints(history: History) -> dict[str, float]:
    """Figures of the setpoints from the first one to the landing."""
    begun = {event.what.partition(":")[0]: event.time_s for event in history.phases}
    end_s = begun.get("land", math.inf)
    armed_s = begun.get("takeoff", math.nan)
    last_s = history.position[-1, 0] if len(history.position) else math.nan
    values = {"flight_s": last_s - armed_s}
    setpoint = history.setpoint[history.setpoint[:, 0] < end_s]
    if len(setpoint) > 1:
        gaps = np.diff(setpoint[:, 0:2], axis=0)
        values["setpoint_hz"] = _hz(setpoint)
        values["setpoint_gap_max_s"], values["setpoint_gap_wall_max_s"] = map(float, gaps.max(0))
    return values


def delay(history: History) -> dict[str, float]:
    """Delay of the link (TIMESYNC), and the last one identified: from telemetry to effect."""
    values = {}
    if len(history.link_delay):
        late_ms = 1e3 * history.link_delay[:, 1]
        values["link_delay_p50_ms"], values["link_delay_p99_ms"] = np.percentile(late_ms, (50, 99))
    known = history.identified[np.isfinite(history.identified[:, 1])]
    if len(known):
        values["delay_ms"], values["delay_sd_ms"] = 1e3 * known[-1, 1:3]
    return {name: float(value) for name, value in values.items()}


def _hz(rows: Array) -> float:
    span_s = rows[-1, 0] - rows[0, 0] if len(rows) > 1 else 0.0
    return float((len(rows) - 1) / span_s) if span_s > 0 else math.nan
