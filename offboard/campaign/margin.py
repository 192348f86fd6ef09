"""The robustness margin of a flight: how far it stayed from breaking a promise.

Each term is 1 where nothing of its limit was used, 0 at the limit, and negative beyond it. The
margin is the least of them; it is at most `NOT_COMPLETED` for a flight that was not completed
(landed early, handed back, crashed).

| term | of | limit |
|---|---|---|
| error | largest position error while tracking, as the vehicle estimates it | `error_m` |
| tilt | largest tilt while tracking | `tilt_deg` |
| clearance | least true distance to the controller's keep-out volumes | `clearance_m` |
| age | age of telemetry while tracking (link delay, 99th percentile) | `age_s` |
| authority | share of decisions at a limit of control law or vehicle | `at_bound` |
| touchdown | downward speed at touch-down | `touchdown_mps` |
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from pydantic import Field

from offboard.analysis.history import History
from offboard.control.base import ControllerSettings
from offboard.control.horizon.keep_out import clearances
from offboard.documents.parameters import Parameters

NOT_COMPLETED = -1.0
NOT_FLOWN = -2.0  # no log, or a flight that never began
LOWEST = -9.0  # terms are cut here, so that a divergence does not hide all others


class Promises(Parameters):
    """Limits that a flight must keep."""

    error_m: float = Field(default=0.5, gt=0, le=100)
    tilt_deg: float = Field(default=60.0, gt=0, le=90)
    clearance_m: float = Field(default=0.1, gt=0, le=100)
    age_s: float = Field(default=0.5, gt=0, le=10)
    at_bound: float = Field(default=0.5, gt=0, le=1)
    touchdown_mps: float = Field(default=2.0, gt=0, le=20)


def terms(
    promises: Promises,
    figures: Mapping[str, float],
    flown: History,
    controller: ControllerSettings,
) -> dict[str, float]:
    """The terms by name; without those that the log does not hold."""
    used = {
        "error": figures["max_position_m"] / promises.error_m,
        "tilt": figures["tilt_max_deg"] / promises.tilt_deg,
        "age": 1e-3 * figures["link_delay_p99_ms"] / promises.age_s,
        "authority": figures["at_bound_share"] / promises.at_bound,
        "touchdown": figures["touchdown_mps"] / promises.touchdown_mps,
    }
    margins = {name: 1.0 - share for name, share in used.items()}
    margins["clearance"] = _clearance(flown, controller) / promises.clearance_m - 1.0
    if figures["completed"] != 1.0:
        margins["completed"] = NOT_COMPLETED
    return {
        name: max(LOWEST, min(1.0, value))
        for name, value in margins.items()
        if not math.isnan(value)
    }


def _clearance(flown: History, controller: ControllerSettings) -> float:
    """Least true distance to a keep-out volume in metres, NaN without volumes or positions."""
    volumes = getattr(controller, "keep_out", ())
    begun = [event.time_s for event in flown.phases if event.what.startswith("track")]
    path = flown.truth if len(flown.truth) else flown.position
    if not volumes or not begun or not len(path):
        return math.nan
    rows = path[path["time_s"] >= begun[0]]
    if not len(rows):
        return math.nan
    places = rows["position_ned_m"].astype(np.float64)
    from_start = places - path["position_ned_m"][0]
    return float(np.min(clearances(volumes, rows["time_s"] - begun[0], from_start)))
