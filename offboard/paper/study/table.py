"""A table of the page: columns, rows, remarks; and its CSV and JSON. Knows no content."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

Cell = float | int | str | None
Row = dict[str, Cell]


@dataclass(frozen=True, slots=True)
class Column:
    """`key` in the rows and in the files, `heading` on the page."""

    key: str
    heading: str


@dataclass(frozen=True, slots=True)
class Table:
    """`notes` say what may be compared with what, and what the table shows."""

    title: str
    columns: Sequence[Column]
    rows: Sequence[Row]
    notes: Sequence[str] = ()

    def to_csv(self) -> str:
        text = io.StringIO()
        writer = csv.DictWriter(text, [column.key for column in self.columns], lineterminator="\n")
        writer.writeheader()
        for row in self.rows:
            writer.writerow({column.key: row.get(column.key) for column in self.columns})
        return text.getvalue()

    def to_json(self) -> str:
        document: dict[str, Any] = {
            "title": self.title,
            "columns": {column.key: column.heading for column in self.columns},
            "rows": [
                {column.key: _plain(row.get(column.key)) for column in self.columns}
                for row in self.rows
            ],
            "notes": list(self.notes),
        }
        return json.dumps(document, indent=1, allow_nan=False) + "\n"


def shown(cell: Cell) -> str:
    """A cell for a reader: four significant digits, "-" where there is nothing."""
    if cell is None or (isinstance(cell, float) and math.isnan(cell)):
        return "–"
    if isinstance(cell, str):
        return cell
    if isinstance(cell, int) or (cell == round(cell) and abs(cell) < 1e5):
        return f"{cell:.0f}"
    if 1e-4 <= abs(cell) < 1e5:
        return f"{cell:.4g}"
    return f"{cell:.3e}"


def _plain(cell: Cell) -> Cell:
    return None if isinstance(cell, float) and not math.isfinite(cell) else cell
