"""Groups of flights that differ in seed and draw only, with their success and its interval."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from offboard.campaign.cases import Case
from offboard.campaign.table import Row

CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class Group:
    """Flights of one combination. `low` and `high` are Wilson's interval of the success rate."""

    name: str
    scenario: str
    rows: tuple[Row, ...]
    low: float
    high: float

    @property
    def flights(self) -> int:
        return len(self.rows)

    @property
    def successes(self) -> int:
        return sum(not row.failed for row in self.rows)

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

    def percentiles(self, figure: str) -> tuple[float, ...]:
        """5th, 50th and 95th percentile; NaN without values."""
        values = self.values(figure)
        if not values:
            return (float("nan"),) * 3
        return tuple(np.percentile(values, (5.0, 50.0, 95.0)).tolist())


def groups(rows: Sequence[Row], drawn: frozenset[str]) -> list[Group]:
    """The groups in the order of the table; `drawn` are the keys of the sample."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row.case.scenario, _name(row.case, drawn)), []).append(row)
    return [
        Group(name, scenario, tuple(own), *wilson(sum(not r.failed for r in own), len(own)))
        for (scenario, name), own in found.items()
    ]


def wilson(successes: int, flights: int) -> tuple[float, float]:
    """The interval of a success rate, Wilson's score, CONFIDENCE."""
    interval = stats.binomtest(successes, flights).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def _name(case: Case, drawn: frozenset[str]) -> str:
    names = [case.controller or "", case.reference or "", case.vehicle or ""]
    names += [case.sim_vehicle or "", "" if case.firmware == "px4" else case.firmware]
    names += [f"{key}={value}" for key, value in case.values if key not in drawn]
    return " ".join(filter(None, names)) or case.config
