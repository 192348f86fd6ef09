"""Figures of the link: rates, gaps and repetitions of telemetry, gaps of setpoints, delays.

From the stretches of a flight to figures of a Score, all in vehicle time as in the flight itself.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.history import History
from offboard.analysis.verdict import begin_times

Array = NDArray[np.float64]


class Gaps:
    """Number of different stamps, the longest gap between them, and how many came late or again."""

    def __init__(self) -> None:
        self._count = self._late = self._stamps = 0
        self._first_s = math.nan
        self._newest_s = math.nan
        self.longest_s = 0.0

    def add(self, stamps: Array) -> None:
        """Stamps in the order of arrival, the next portion."""
        if not len(stamps):
            return
        before = np.fmax.accumulate(np.insert(stamps, 0, self._newest_s))
        newer = ~(stamps <= before[:-1])
        self._first_s = np.fmin(self._first_s, stamps.min())
        self._late += int((~newer).sum())
        self._count += len(stamps)
        self._stamps += len(np.unique(stamps))
        self.longest_s = max(self.longest_s, float(np.nanmax(np.diff(before), initial=0.0)))
        self._newest_s = float(before[-1])

    @property
    def hz(self) -> float:
        span_s = self._newest_s - self._first_s
        return float((self._stamps - 1) / span_s) if span_s > 0.0 else math.nan

    @property
    def late_share(self) -> float:
        return self._late / (self._count - 1) if self._count > 1 else math.nan


class Link:
    """Call `add` with each stretch of a flight, then `figures` with the last one."""

    def __init__(self) -> None:
        self._position, self._attitude = Gaps(), Gaps()
        self._setpoints = 0
        self._first_s = math.nan
        self._before: Array | None = None  # stamp and wall time of the newest setpoint
        self._gaps_s = np.zeros(2)
        self._tracked = False

    def add_track(self, flown: History, begin_s: float, end_s: float, *, first: bool) -> None:
        """Evaluate the telemetry of a window of TRACK."""
        self._tracked = True
        for gaps, rows in ((self._position, flown.position), (self._attitude, flown.attitude)):
            stamps = rows[:, 0]
            after = stamps >= begin_s if first else stamps > begin_s
            gaps.add(stamps[after & (stamps <= end_s)])

    def add(self, flown: History, begin_s: float, until_s: float) -> None:
        """Evaluate the setpoints after `begin_s`, up to `until_s` or the landing."""
        end_s = begin_times(flown.phases).get("land", math.inf)
        stamps = flown.setpoint[:, 0]
        rows = flown.setpoint[(stamps > begin_s) & (stamps <= until_s) & (stamps < end_s), :2]
        if not len(rows):
            return
        gaps = np.diff(rows if self._before is None else np.vstack((self._before, rows)), axis=0)
        self._gaps_s = np.maximum(self._gaps_s, gaps.max(axis=0, initial=0.0))
        self._first_s = np.fmin(self._first_s, rows[0, 0])
        self._before = rows[-1]
        self._setpoints += len(rows)

    def figures(self, flown: History) -> dict[str, float]:
        """Figures of a Score. `flown`: the last stretch."""
        armed_s = begin_times(flown.phases).get("takeoff", math.nan)
        last_s = flown.position[-1, 0] if len(flown.position) else math.nan
        values = {"flight_s": float(last_s - armed_s), **_delay(flown)}
        if self._tracked:
            values |= {
                "position_hz": self._position.hz,
                "attitude_hz": self._attitude.hz,
                "position_gap_max_s": self._position.longest_s,
                "attitude_gap_max_s": self._attitude.longest_s,
                "stale_share": self._position.late_share,
            }
        if self._setpoints > 1 and self._before is not None:
            span_s = float(self._before[0] - self._first_s)
            values["setpoint_hz"] = (self._setpoints - 1) / span_s if span_s > 0.0 else math.nan
            values["setpoint_gap_max_s"], values["setpoint_gap_wall_max_s"] = self._gaps_s.tolist()
        return values


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
