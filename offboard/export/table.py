"""Tables: CSV. One row for each sample, in the order of vehicle time.

`source` is the name of the sample's series; columns of the other series are empty in its row. Rows
with the source `event` have a text in the column `event`.
"""

from __future__ import annotations

import csv
import heapq
import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from offboard.export.series import PHASE, Flight, Series, phase_name
from offboard.link.log import new_file

EVENT = "event"


def write_csv(flight: Flight, path: Path) -> None:
    """Write a CSV file, UTF-8, with a line of column names. Raises UserError."""
    parts = list(flight.series.values())
    columns = [column for part in parts for column in part.columns]
    rows = [_rows(part, columns) for part in parts]
    blank = [""] * len(columns)
    events: Iterator[list[Any]] = (
        [e.time_s, e.unix_s, EVENT, *blank, f"{e.who}: {e.what}"] for e in flight.events
    )
    with new_file(path) as file, io.TextIOWrapper(file, "utf-8", newline="") as text:
        writer = csv.writer(text)
        writer.writerow(["vehicle_time_s", "unix_time_s", "source", *columns, EVENT])
        writer.writerows(heapq.merge(*rows, events, key=_time_s))


def _rows(series: Series, columns: list[str]) -> Iterator[list[Any]]:
    """One for each sample, with the columns of all series, in the order of time."""
    order = np.argsort(series.time_s, kind="stable")
    before = columns.index(series.columns[0])
    after = len(columns) - before - len(series.columns) + 1  # and no event
    for at, unix_s, values in zip(
        *(each[order].tolist() for each in (series.time_s, series.unix_s, series.values)),
        strict=True,
    ):
        cells = [_cell(*each) for each in zip(series.columns, values, strict=True)]
        yield [at, unix_s, series.name, *[""] * before, *cells, *[""] * after]


def _time_s(row: Any) -> float:
    return float(row[0])


def _cell(column: str, value: float) -> float | str:
    if math.isnan(value):
        return ""
    return phase_name(value) if column == PHASE else value
