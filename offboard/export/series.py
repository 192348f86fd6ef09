"""Series: a flight as named columns over vehicle time, with the unit in each name; and CSV.

The frame is NED, the body's is FRD, quaternions are w, x, y, z from NED to FRD, thrust without a
unit is normalised.
"""

from __future__ import annotations

import csv
import heapq
import io
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.analysis import history, tlog
from offboard.analysis.history import Event, Rows
from offboard.documents.errors import UserError
from offboard.flight.phases import PHASE_CODES
from offboard.flight.record import FIELDS
from offboard.link.log import new_file

Array = NDArray[np.float64]


def _vectors(what: str, unit: str) -> tuple[str, ...]:
    return tuple(f"{what}_{axis}_{unit}" for axis in ("north", "east", "down"))


def _quaternion(what: str) -> tuple[str, ...]:
    return tuple(f"{what}_{part}" for part in "wxyz")


_COLUMNS = {
    "position": (*_vectors("position", "m"), *_vectors("velocity", "mps")),
    "attitude": (
        *_quaternion("attitude"),
        *(f"rate_{axis}_radps" for axis in ("roll", "pitch", "yaw")),
    ),
    "truth": _vectors("true_position", "m"),
    "reference": (
        *_vectors("reference_position", "m"),
        *_vectors("reference_velocity", "mps"),
        *_vectors("reference_acceleration", "mps2"),
        "reference_heading_rad",
    ),
    "setpoint": (*_quaternion("setpoint"), "setpoint_thrust"),
    "decision": tuple(f"decision_{name}" for name in FIELDS),
    "heartbeat": ("armed", "system_status"),
}
_ARRAYS = {"decision": "records"}  # of History, where they have another name
EVENT = "event"  # source and column of texts
PHASE = "decision_phase"  # whose numbers tables show as names
_PHASES: dict[int, str] = {code: phase.value for phase, code in PHASE_CODES.items()}
_AUTOPILOTS = {"px4": "PX4", "ardupilot": "ArduPilot"}  # as MAV_AUTOPILOT names them


def phase_name(number: float) -> str:
    """The name of a phase in the column PHASE."""
    return _PHASES[int(number)]


@dataclass(frozen=True, slots=True)
class Series:
    """Samples of one kind: `time_s` (N,) of vehicle time, `unix_s` (N,) of the log, and `values`
    (N, len(columns))."""

    name: str
    columns: tuple[str, ...]
    time_s: Array
    unix_s: Array
    values: Array


@dataclass(frozen=True, slots=True)
class Flight:
    """`series` in which something was recorded, by name; `events` in the order of time. `begun`:
    vehicle time and Unix time of the first telemetry. `damage` says what of the log could not be
    read."""

    series: dict[str, Series]
    events: tuple[Event, ...]
    begun: tuple[float, float]
    autopilot: str
    damage: str


def read(path: Path) -> Flight:
    """The flight in a directory or .tlog. Raises TlogError, or UserError without telemetry."""
    log = tlog.read(tlog.find(path))
    flown = history.gather(log)
    telemetry = [rows[0] for rows in (flown.position, flown.attitude) if len(rows)]
    if not telemetry:
        raise UserError(f"{log.path} holds no telemetry with a time stamp: nothing to export")
    begun = min((float(row["time_s"]), float(row["unix_s"])) for row in telemetry)
    events = tuple(event for event in flown.events() if np.isfinite(event.time_s))
    arrays = {name: getattr(flown, _ARRAYS.get(name, name)) for name in _COLUMNS}
    series = {name: each for name in arrays if len((each := _series(name, arrays[name])).time_s)}
    autopilot = _AUTOPILOTS[flown.dialect.name] if flown.dialect else "unknown"
    return Flight(series, events, begun, autopilot, flown.damage)


def _series(name: str, rows: Rows) -> Series:
    """Without the samples from before any telemetry, whose time is NaN."""
    rows = rows[np.isfinite(rows["time_s"])]
    times = ("time_s", "unix_s")
    columns = [rows[column] for column in rows.dtype.names or () if column not in times]
    return Series(name, _COLUMNS[name], rows["time_s"], rows["unix_s"], np.column_stack(columns))


def write_csv(flight: Flight, path: Path) -> None:
    """Write a CSV file, UTF-8, with a line of column names. Raises UserError.

    One row for each sample, in the order of vehicle time. `source` is the name of its series;
    columns of the other series are empty. Rows with the source `event` have a text in the column
    `event`.
    """
    parts = list(flight.series.values())
    columns = [column for part in parts for column in part.columns]
    rows = [_csv_rows(part, columns) for part in parts]
    blank = [""] * len(columns)
    events: Iterator[list[Any]] = (
        [e.time_s, e.unix_s, EVENT, *blank, f"{e.who}: {e.what}"] for e in flight.events
    )
    with new_file(path) as file, io.TextIOWrapper(file, "utf-8", newline="") as text:
        writer = csv.writer(text)
        writer.writerow(["vehicle_time_s", "unix_time_s", "source", *columns, EVENT])
        writer.writerows(heapq.merge(*rows, events, key=_time_s))


def _csv_rows(series: Series, columns: list[str]) -> Iterator[list[Any]]:
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
