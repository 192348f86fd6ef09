"""Metrics of the decisions of a flight, and of its link: rates, gaps and repetitions of telemetry,
gaps of setpoints, delays.

From the columns of a flight to values of a Score, all in vehicle time as in the flight itself.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.history import History
from offboard.analysis.verdict import begin_times
from offboard.flight.outbox import Refusal
from offboard.flight.phases import PHASE_CODES, Phase

Array = NDArray[np.float64]


def decision_metrics(flown: History) -> dict[str, float]:
    """Values of a Score; empty without records."""
    columns = flown.records
    if not len(columns):
        return {}
    refused = columns["refused"].astype(np.int64)

    def known(name: str) -> Array:
        values = columns[name].astype(np.float64)
        return values[np.isfinite(values)]

    def refusals(flag: int) -> float:
        return float(((refused & flag) != 0).sum())

    answer_ms, age_ms = 1e3 * known("answer_s"), 1e3 * known("age_s")
    solve_ms, gap = 1e3 * known("solve_time_s"), known("gap")
    # A setpoint without certificate was changed by the gate, in EXCITE perhaps by a step
    changed = np.isnan(columns["at_bound"]) & np.isfinite(columns["thrust_mps2"])
    limited = changed & (columns["phase"] != PHASE_CODES[Phase.EXCITE])
    at_bound = np.where(limited, 1.0, columns["at_bound"])
    skipped = columns["missed_ticks"][columns["pause_s"] > 0.0]
    return {
        "decisions": float(len(refused)),
        "answer_p50_ms": _percentile(answer_ms, 50),
        "answer_p99_ms": _percentile(answer_ms, 99),
        "answer_max_ms": _percentile(answer_ms, 100),
        "setpoint_age_p99_ms": _percentile(age_ms, 99),
        "setpoint_age_max_ms": _percentile(age_ms, 100),
        "missed_ticks": float(known("missed_ticks").sum()),
        "skipped_ticks": float(skipped.sum(dtype=np.float64)),
        "pause_max_s": float(columns["pause_s"].max()),
        "refused_setpoints": float((refused != 0).sum()),
        "refused_late": refusals(Refusal.LATE),
        "refused_stale": refusals(Refusal.STALE),
        "refused_not_ours": refusals(Refusal.NOT_OURS),
        "refused_unusable": refusals(Refusal.UNUSABLE),
        "other_datagrams": float(known("other_datagrams").sum()),
        "solve_time_p50_ms": _percentile(solve_ms, 50),
        "solve_time_p99_ms": _percentile(solve_ms, 99),
        "certified_share": len(gap) / len(refused),
        "gap_median": _percentile(gap, 50),
        "gap_max": _percentile(gap, 100),
        "spread_median": _percentile(known("spread"), 50),
        "at_bound_share": _mean(at_bound[np.isfinite(at_bound)]),
        "cut_short_share": _mean(known("cut_short")),
        "hover_thrust": float(columns["hover_thrust"][-1]),
    }


def link_metrics(flown: History, window: tuple[float, float] | None) -> dict[str, float]:
    """Values of a Score. `window`: first and last vehicle time of TRACK; without it, the telemetry
    has none."""
    begun = begin_times(flown.phases)
    last_s = float(flown.position["time_s"][-1]) if len(flown.position) else math.nan
    sent = flown.setpoint[flown.setpoint["time_s"] < begun.get("land", math.inf)]
    values = {"flight_s": last_s - begun.get("takeoff", math.nan)}
    if len(sent) > 1:
        span_s = float(sent["time_s"][-1] - sent["time_s"][0])
        values["setpoint_hz"] = (len(sent) - 1) / span_s if span_s > 0.0 else math.nan
        values["setpoint_gap_max_s"] = float(np.diff(sent["time_s"]).max(initial=0.0))
        values["setpoint_gap_wall_max_s"] = float(np.diff(sent["unix_s"]).max(initial=0.0))
    if len(flown.link_delay):
        late_ms = 1e3 * flown.link_delay["delay_s"]
        values["link_delay_p50_ms"] = _percentile(late_ms, 50)
        values["link_delay_p99_ms"] = _percentile(late_ms, 99)
    delay_s = flown.identified["tilt_delay_s"]
    if len(delay_s := delay_s[np.isfinite(delay_s[:, 0])]):
        values["delay_ms"], values["delay_sd_ms"] = (1e3 * delay_s[-1].astype(float)).tolist()
    for name, rows in (("position", flown.position), ("attitude", flown.attitude)):
        if window is not None:
            stamps = rows["time_s"]
            stamps = stamps[(stamps >= window[0]) & (stamps <= window[1])]
            intervals = np.diff(np.maximum.accumulate(stamps))  # repeated and late ones: zero
            span_s = float(np.ptp(stamps)) if len(stamps) else 0.0
            count = len(np.unique(stamps))
            values[f"{name}_hz"] = (count - 1) / span_s if span_s > 0.0 else math.nan
            values[f"{name}_gap_max_s"] = float(intervals.max(initial=0.0))
            if name == "position":
                values["stale_share"] = _mean(intervals <= 0.0)
    return values


def _percentile(values: Array, share: float) -> float:
    return float(np.percentile(values, share)) if len(values) else math.nan


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if len(values) else math.nan
