"""Tables: CSV. One row for each sample, in the order of vehicle time.

`source` is the name of the sample's series; columns of the other series are empty in its row. Rows
with the source `event` have a text in the column `event`.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np

from offboard.export.series import PHASE, Array, Flight, phase_name
from offboard.link.log import new_file

EVENT = "event"


def write_csv(flight: Flight, path: Path) -> None:
    """Write a CSV file, UTF-8, with a line of column names. Raises UserError."""
    columns = _columns(flight)
    with new_file(path) as file, io.TextIOWrapper(file, "utf-8", newline="") as text:
        writer = csv.writer(text)
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow([_cell(value) for value in row])


def _columns(flight: Flight) -> dict[str, Any]:
    """All columns of the table, as arrays of one length."""
    parts = list(flight.series.values())
    events_s = np.array([event.time_s for event in flight.events], dtype=np.float64)
    time_s = np.concatenate([*(part.time_s for part in parts), events_s])
    order = np.argsort(time_s, kind="stable")
    sources = [part.name for part in parts for _ in part.time_s] + [EVENT] * len(events_s)
    texts = [""] * (len(time_s) - len(events_s))
    texts += [f"{event.who}: {event.what}" for event in flight.events]
    columns: dict[str, Any] = {
        "vehicle_time_s": time_s[order],
        "unix_time_s": flight.unix_s(time_s)[order],
        "source": np.array(sources, dtype=object)[order],
    }
    first = 0
    for part in parts:
        for column, samples in zip(part.columns, part.values.T, strict=True):
            values: Array = np.full(len(time_s), np.nan)
            values[first : first + len(part.time_s)] = samples
            columns[column] = values[order]
            if column == PHASE:
                names = [phase_name(each) if np.isfinite(each) else None for each in values[order]]
                columns[column] = np.array(names, dtype=object)
        first += len(part.time_s)
    columns[EVENT] = np.array([text or None for text in texts], dtype=object)[order]
    return columns


def _cell(value: object) -> object:
    if isinstance(value, float):
        return "" if np.isnan(value) else repr(float(value))
    return "" if value is None else value
