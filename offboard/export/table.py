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
    rows = [_rows(flight, part, columns) for part in parts]
    told = [(e.time_s, float(flight.unix_s(e.time_s)), e.who, e.what) for e in flight.events]
    blank = [""] * len(columns)
    events: Iterator[list[Any]] = (
        [at, unix_s, EVENT, *blank, f"{who}: {what}"] for at, unix_s, who, what in told
    )
    with new_file(path) as file, io.TextIOWrapper(file, "utf-8", newline="") as text:
        writer = csv.writer(text)
        writer.writerow(["vehicle_time_s", "unix_time_s", "source", *columns, EVENT])
        writer.writerows(heapq.merge(*rows, events, key=_time_s))


def _rows(flight: Flight, series: Series, columns: list[str]) -> Iterator[list[Any]]:
    """One for each sample, with the columns of all series, in the order of time."""
    samples = series.values[np.argsort(series.time_s, kind="stable")].tolist()
    time_s = np.sort(series.time_s)
    unix_s = flight.unix_s(time_s)
    before = columns.index(series.columns[0])
    after = len(columns) - before - len(series.columns) + 1  # and no event
    for at, unix, values in zip(time_s.tolist(), unix_s.tolist(), samples, strict=True):
        cells = [_cell(*each) for each in zip(series.columns, values, strict=True)]
        yield [at, unix, series.name, *[""] * before, *cells, *[""] * after]


def _time_s(row: Any) -> float:
    return float(row[0])


def _cell(column: str, value: float) -> float | str:
    if math.isnan(value):
        return ""
    return phase_name(value) if column == PHASE else value
