"""The table of a campaign: one row per flight, as CSV, the same bytes on every run."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from offboard.analysis.requirement import Requirement
from offboard.analysis.score import FIGURES
from offboard.campaign.cases import Case
from offboard.campaign.results import WALL_TIMES, Record

CASE_COLUMNS = ("controller", "reference", "scenario", "vehicle", "sim_vehicle", "firmware")
FIGURE_COLUMNS = tuple(name for name in FIGURES if name not in WALL_TIMES)


@dataclass(frozen=True, slots=True)
class Row:
    """A finished flight. `failed` says why it does not count as a success, empty if it does."""

    case: Case
    record: Record
    failed: str

    @property
    def severity(self) -> tuple[float, str]:
        """Sorts the worst flight first."""
        return self.record.margin, self.case.key


def row_of(case: Case, record: Record, requirements: Sequence[Requirement]) -> Row:
    """The row of a finished flight: completed, with all requirements met, or why not."""
    failed = ""
    if not record.completed:
        failed = record.sentence
    else:
        figures = {name: record.figures.get(name, float("nan")) for name in FIGURES}
        missed = [each.sentence(figures) for each in requirements if not each.met(figures)]
        failed = "; ".join(missed)
    return Row(case, record, failed)


def columns(rows: Sequence[Row]) -> dict[str, list[Any]]:
    """The table by columns; what a flight does not have is None."""
    keys = dict.fromkeys(key for row in rows for key, _ in row.case.values)
    found: dict[str, list[Any]] = {"case": [row.case.key for row in rows]}
    for name in CASE_COLUMNS:
        found[name] = [getattr(row.case, name) for row in rows]
    values = [dict(row.case.values) for row in rows]
    for key in keys:
        found[key] = [_scalar(own.get(key)) for own in values]
    found["seed"] = [row.case.seed for row in rows]
    found["success"] = [int(not row.failed) for row in rows]
    found["exit_code"] = [row.record.exit_code for row in rows]
    found["ended"] = [row.record.sentence for row in rows]
    found["failed"] = [row.failed for row in rows]
    found["margin"] = [row.record.margin for row in rows]
    found["weakest"] = [row.record.weakest for row in rows]
    for name in FIGURE_COLUMNS:
        found[name] = [row.record.figures.get(name) for row in rows]
    found["fly_again"] = [row.case.line for row in rows]
    return found


def _scalar(value: Any) -> Any:
    plain = value is None or (isinstance(value, str | int | float) and not isinstance(value, bool))
    return value if plain else json.dumps(value)


def as_csv(table: Mapping[str, Sequence[Any]]) -> str:
    """The table as CSV; numbers with all digits."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table)
    writer.writerows(zip(*table.values(), strict=True))
    return text.getvalue()
