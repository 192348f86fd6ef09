"""Metrics of the decisions of a flight, from the records of its ticks."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.history import History
from offboard.flight.phases import PHASE_CODES, Phase
from offboard.flight.setpoint import Refusal

Array = NDArray[np.float64]


def decision_figures(flown: History) -> dict[str, float]:
    """Values of a Score; empty without records."""
    columns = flown.records
    if not len(columns):
        return {}
    refused = columns["refused"].astype(np.int64)

    def known(name: str) -> Array:
        values: Array = columns[name][np.isfinite(columns[name])]
        return values

    def refusals(flag: int) -> float:
        return float(((refused & flag) != 0).sum())

    answer_ms, age_ms = 1e3 * known("answer_s"), 1e3 * known("age_s")
    solve_ms, gap = 1e3 * known("solve_time_s"), known("gap")
    # A setpoint without certificate was changed by the gate, in EXCITE perhaps by a step
    changed = np.isnan(columns["at_bound"]) & np.isfinite(columns["thrust_mps2"])
    limited = changed & (columns["phase"] != PHASE_CODES[Phase.EXCITE])
    at_bound = np.where(limited, 1.0, columns["at_bound"])
    return {
        "decisions": float(len(refused)),
        "answer_p50_ms": _percentile(answer_ms, 50),
        "answer_p99_ms": _percentile(answer_ms, 99),
        "answer_max_ms": _percentile(answer_ms, 100),
        "setpoint_age_p99_ms": _percentile(age_ms, 99),
        "setpoint_age_max_ms": _percentile(age_ms, 100),
        "missed_ticks": float(known("missed_ticks").sum()),
        "skipped_ticks": float(columns["missed_ticks"][columns["pause_s"] > 0.0].sum()),
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


def _percentile(values: Array, share: float) -> float:
    return float(np.percentile(values, share)) if len(values) else math.nan


def _mean(values: Array) -> float:
    return float(values.mean()) if len(values) else math.nan
