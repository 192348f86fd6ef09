"""Groups of flights that differ in seed and draw only: success, medians and ranges."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from offboard.campaign.cases import Case
from offboard.campaign.table import Row

CONFIDENCE = 0.95
ERROR = "rmse_position_m"
EQUAL_SHARE = 0.01  # medians that are closer than this share of the best are equal
BEST = (
    "* best: lowest median RMSE of its reference and scenario; or a median within the range of the "
    f"best, or within {EQUAL_SHARE:.0%} of its median."
)


@dataclass(frozen=True, slots=True)
class Group:
    """Flights of one combination. `low` and `high` are Wilson's interval of the success rate;
    `ends` the percentiles that are the range of a figure; `best`: see `marked`."""

    name: str
    scenario: str
    rows: tuple[Row, ...]
    low: float
    high: float
    ends: tuple[float, float]
    best: bool = False

    @property
    def case(self) -> Case:
        """The first flight."""
        return self.rows[0].case

    @property
    def flights(self) -> int:
        return len(self.rows)

    @property
    def successes(self) -> int:
        return sum(not row.failed for row in self.rows)

    @property
    def failed(self) -> int:
        return self.flights - self.successes

    @property
    def reasons(self) -> list[str]:
        """Why flights failed, each reason once."""
        return list(dict.fromkeys(row.failed for row in self.rows if row.failed))

    def values(self, figure: str) -> list[float]:
        """One figure of every completed flight; `margin` of every flight."""
        if figure == "margin":
            return [row.record.margin for row in self.rows]
        completed = (row.record for row in self.rows if row.record.completed)
        return [r.figures[figure] for r in completed if figure in r.figures]

    def spread(self, figure: str) -> tuple[float, float, float]:
        """Lower end of the range, median and upper end; NaN without values. Of `success`: the rate
        with its interval."""
        if figure == "success":
            return self.low, self.successes / self.flights, self.high
        values = self.values(figure)
        if not values:
            return math.nan, math.nan, math.nan
        low, high = self.ends
        lowest, median, highest = np.percentile(values, (low, 50.0, high)).tolist()
        return lowest, median, highest

    def shown(self, figure: str) -> str:
        """Median and range of a figure as text, empty without values."""
        low, middle, high = map(digits, self.spread(figure))
        return middle if low == high else f"{middle} [{low}\N{EN DASH}{high}]"


def groups(
    rows: Sequence[Row],
    drawn: frozenset[str] = frozenset(),
    ends: tuple[float, float] = (5.0, 95.0),
) -> list[Group]:
    """The groups in the order of the table; `drawn` are the keys of the sample, `ends` the
    percentiles of their ranges."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row.case.scenario, _name(row.case, drawn)), []).append(row)
    return [
        Group(name, scenario, tuple(own), *wilson(sum(not r.failed for r in own), len(own)), ends)
        for (scenario, name), own in found.items()
    ]


def marked(flown: Sequence[Group]) -> list[Group]:
    """The groups with the best of each reference and scenario marked.

    The best have no failed flight, and their median position error is the lowest, or within the
    range of that one's flights, or within EQUAL_SHARE of its median.
    """
    found: list[Group] = []
    for _, block in itertools.groupby(flown, lambda group: (group.case.reference, group.scenario)):
        members = list(block)
        errors = [_error(group) for group in members]
        median, highest = min(errors)
        bound = max(highest, (1.0 + EQUAL_SHARE) * median)
        found += [
            replace(group, best=math.isfinite(error) and error <= bound)
            for group, (error, _) in zip(members, errors, strict=True)
        ]
    return found


def _error(group: Group) -> tuple[float, float]:
    """Median and highest position error, infinite where a flight failed."""
    _, median, highest = group.spread(ERROR)
    return (math.inf, math.inf) if group.failed or math.isnan(median) else (median, highest)


def wilson(successes: int, flights: int) -> tuple[float, float]:
    """The interval of a success rate, Wilson's score, CONFIDENCE."""
    interval = stats.binomtest(successes, flights).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def digits(value: float) -> str:
    """Three significant digits, empty for what is not finite."""
    if not math.isfinite(value):
        return ""
    value = float(f"{value:.3g}")
    size = math.floor(math.log10(abs(value))) if value else 0
    return f"{value:.2e}" if size < -4 else f"{value:.{max(0, 2 - size)}f}"


def _name(case: Case, drawn: frozenset[str]) -> str:
    names = [case.controller or "", case.reference or "", case.vehicle or ""]
    names += [case.sim_vehicle or "", "" if case.firmware == "px4" else case.firmware]
    names += [f"{key}={value}" for key, value in case.values if key not in drawn]
    return " ".join(filter(None, names)) or case.config
