"""A CSV table of positions over time.

The first row names the columns, in any order: `time_s`; `north_m` (or `x`, `x_m`); `east_m` (or
`y`, `y_m`); `down_m` (or `z`, `z_m`; positive down) or `altitude_m` (positive up); optionally
`course_deg` (heading, clockwise from north). Other columns are refused.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROWS_MIN = 4
DURATION_MAX_S = 3600.0  # the same as for the shape `hover`
_NAMES = {
    "time_s": "time_s",
    "north_m": "north_m", "x": "north_m", "x_m": "north_m",
    "east_m": "east_m", "y": "east_m", "y_m": "east_m",
    "down_m": "down_m", "z": "down_m", "z_m": "down_m",
    "altitude_m": "altitude_m",
    "course_deg": "course_deg",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Table:
    """Rows as arrays: times_s (N,) from 0, points_ned_m (N, 3), heading_rad (N,), unwrapped, or
    None without that column."""

    times_s: Array
    points_ned_m: Array
    heading_rad: Array | None


def parse(text: str, name: str) -> Table:
    """Parse CSV text. Times are shifted to begin at 0.

    Raises ValueError, whose text names the table `name` and counts rows from 1, the header."""
    rows = [
        (number, row)
        for number, row in enumerate(_rows(text, name), start=1)
        if any(cell.strip() for cell in row)
    ]
    if not rows:
        raise ValueError(f"{name} is empty: it needs a header and at least {ROWS_MIN} rows")
    columns = _header(rows[0][1], name, rows[0][0])
    body = rows[1:]
    if len(body) < ROWS_MIN:
        raise ValueError(f"{name} has {len(body)} rows of data: at least {ROWS_MIN} are needed")
    values = np.array([_numbers(row, columns, name, number) for number, row in body])
    by_name = dict(zip(columns, values.T, strict=True))
    times = by_name["time_s"]
    for index in range(1, len(body)):
        if times[index] <= times[index - 1]:
            raise ValueError(
                f"{name}, row {body[index][0]}, column time_s: {times[index]:.12g} does not "
                f"come after {times[index - 1]:.12g}; times must increase"
            )
    if times[-1] - times[0] > DURATION_MAX_S:
        raise ValueError(
            f"{name} lasts {times[-1] - times[0]:.12g} s: at most {DURATION_MAX_S:.0f} s are flown"
        )
    down = by_name["down_m"] if "down_m" in by_name else -by_name["altitude_m"]
    heading = np.unwrap(np.radians(by_name["course_deg"])) if "course_deg" in by_name else None
    points = np.stack([by_name["north_m"], by_name["east_m"], down], axis=1)
    return Table(times - times[0], points, heading)


def _rows(text: str, name: str) -> list[list[str]]:
    try:
        return list(csv.reader(io.StringIO(text.removeprefix("\ufeff"))))
    except csv.Error as error:
        raise ValueError(f"{name} is not a CSV table: {error}") from None


def _header(cells: list[str], name: str, number: int) -> list[str]:
    columns = []
    for cell in cells:
        column = _NAMES.get(cell.strip().lower())
        if column is None:
            raise ValueError(
                f"{name}, row {number}: unknown column {cell.strip()!r}; known, separated "
                "by commas, are time_s, north_m, east_m, down_m (or altitude_m), course_deg"
            )
        if column in columns:
            raise ValueError(f"{name}, row {number}: column {column} is given twice")
        columns.append(column)
    height = "down_m" if "down_m" in columns else "altitude_m"
    for column in ("time_s", "north_m", "east_m", height):
        if column not in columns:
            raise ValueError(f"{name}, row {number}: column {column} is missing")
    if "down_m" in columns and "altitude_m" in columns:
        raise ValueError(f"{name}, row {number}: down_m and altitude_m exclude each other")
    return columns


def _numbers(row: list[str], columns: list[str], name: str, number: int) -> list[float]:
    if len(row) != len(columns):
        raise ValueError(f"{name}, row {number}: {len(row)} cells for {len(columns)} columns")
    values = []
    for cell, column in zip(row, columns, strict=True):
        try:
            value = float(cell)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ValueError(
                f"{name}, row {number}, column {column}: {cell.strip()!r} is not a finite number"
            )
        values.append(value)
    return values
