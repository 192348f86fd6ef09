"""Tables of the study, and the HTML page of all tables and figures."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from offboard.analysis.figure import Figure
from offboard.analysis.page import render
from offboard.documents.plain import plain
from offboard.paper.study.options import SECTIONS
from offboard.paper.study.printed import DOI

Cell = float | int | str | None
Row = dict[str, Cell]

TITLE = "Linear controller design with PSO for UAV trajectory tracking: printed and computed"


@dataclass(frozen=True, slots=True)
class Table:
    """A table of the study.

    Args:
        title: heading on the page.
        columns: key in the rows and in the files -> heading on the page.
        rows: by key; an absent cell is empty.
        notes: what may be compared with what, and what the table shows.
    """

    title: str
    columns: Mapping[str, str]
    rows: Sequence[Row]
    notes: Sequence[str] = ()

    def to_csv(self) -> str:
        text = io.StringIO()
        writer = csv.DictWriter(text, list(self.columns), lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        return text.getvalue()

    def to_json(self) -> str:
        rows = [{key: plain(row.get(key)) for key in self.columns} for row in self.rows]
        document = {
            "title": self.title, "columns": dict(self.columns), "rows": rows,
            "notes": list(self.notes),
        }  # fmt: skip
        return json.dumps(document, indent=1, allow_nan=False) + "\n"


def page(
    pieces: Mapping[str, Table | Figure], missing: Mapping[str, str], facts: Mapping[str, str]
) -> str:
    """The page as text.

    Args:
        pieces: tables and figures by label ("table 2", "figure gap").
        missing: reason for each label that is not there.
        facts: name and value of what describes the run.
    """
    sections = {
        title: {label: pieces[label] for label in labels if label in pieces}
        for title, labels in SECTIONS.items()
    }
    return render(
        "paper/study/page.html",
        title=TITLE,
        doi=DOI,
        facts=facts,
        missing=[f"{label}: {reason}" for label, reason in missing.items()],
        sections={title: shown for title, shown in sections.items() if shown},
        shown=shown,
    )


def shown(cell: Cell) -> str:
    """A cell as text: four significant digits, a dash for nothing."""
    if cell is None or (isinstance(cell, float) and math.isnan(cell)):
        return "–"
    if isinstance(cell, str):
        return cell
    if isinstance(cell, int) or (cell == round(cell) and abs(cell) < 1e5):
        return f"{cell:.0f}"
    return f"{cell:.4g}" if 1e-4 <= abs(cell) < 1e5 else f"{cell:.3e}"
