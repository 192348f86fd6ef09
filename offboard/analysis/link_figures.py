"""Metrics of the link: rates, gaps and repetitions of telemetry, gaps of setpoints, delays.

From the columns of a flight to values of a Score, all in vehicle time as in the flight itself.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.history import History
from offboard.analysis.verdict import begin_times

Array = NDArray[np.float64]


def link_figures(flown: History, window: tuple[float, float] | None) -> dict[str, float]:
    """Values of a Score. `window`: first and last vehicle time of TRACK; without it, the telemetry
    has none."""
    armed_s = begin_times(flown.phases).get("takeoff", math.nan)
    last_s = flown.position[-1, 0] if len(flown.position) else math.nan
    values = {"flight_s": float(last_s - armed_s), **_delay(flown), **_setpoints(flown)}
    if window is None:
        return values
    position, attitude = (_within(rows[:, 0], window) for rows in (flown.position, flown.attitude))
    late = int((~_newer(position)).sum())
    return values | {
        "position_hz": _hz(position),
        "attitude_hz": _hz(attitude),
        "position_gap_max_s": _longest_s(position),
        "attitude_gap_max_s": _longest_s(attitude),
        "stale_share": late / (len(position) - 1) if len(position) > 1 else math.nan,
    }


def _within(stamps: Array, window: tuple[float, float]) -> Array:
    return stamps[(stamps >= window[0]) & (stamps <= window[1])]


def _newer(stamps: Array) -> NDArray[np.bool_]:
    """Which stamps, in the order of arrival, are newer than all before."""
    newer: NDArray[np.bool_] = np.diff(np.maximum.accumulate(stamps), prepend=-math.inf) > 0.0
    return newer


def _hz(stamps: Array) -> float:
    span_s = float(np.ptp(stamps)) if len(stamps) else 0.0
    return (len(np.unique(stamps)) - 1) / span_s if span_s > 0.0 else math.nan


def _longest_s(stamps: Array) -> float:
    return float(np.diff(np.maximum.accumulate(stamps)).max(initial=0.0))


def _setpoints(flown: History) -> dict[str, float]:
    """Figures of the setpoints up to the landing."""
    end_s = begin_times(flown.phases).get("land", math.inf)
    rows = flown.setpoint[flown.setpoint[:, 0] < end_s, :2]
    if len(rows) < 2:
        return {}
    span_s = float(rows[-1, 0] - rows[0, 0])
    gap_s, wall_gap_s = np.diff(rows, axis=0).max(axis=0, initial=0.0).tolist()
    return {
        "setpoint_hz": (len(rows) - 1) / span_s if span_s > 0.0 else math.nan,
        "setpoint_gap_max_s": gap_s,
        "setpoint_gap_wall_max_s": wall_gap_s,
    }


def _delay(flown: History) -> dict[str, float]:
    """Delay of the link (TIMESYNC), and the last one identified: from telemetry to effect."""
    values = {}
    if len(flown.link_delay):
        late_ms = 1e3 * flown.link_delay[:, 1]
        values["link_delay_p50_ms"], values["link_delay_p99_ms"] = np.percentile(late_ms, (50, 99))
    known = flown.identified[np.isfinite(flown.identified[:, 1])]
    if len(known):
        values["delay_ms"], values["delay_sd_ms"] = 1e3 * known[-1, 1:3]
    return {name: float(value) for name, value in values.items()}
