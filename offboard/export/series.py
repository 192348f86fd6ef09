"""A flight as series of named columns over vehicle time, with the unit in each name; and CSV.

The world frame is NED, the body frame FRD. Quaternions are w, x, y, z from NED to FRD. Thrust
without a unit is normalised (0 .. 1).
"""

from __future__ import annotations

import csv
import heapq
import io
import math
from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.analysis import tlog
from offboard.analysis.columns import Rows
from offboard.analysis.history import PHASES, Event, History, gather
from offboard.documents.errors import UserError
from offboard.flight.record import FIELDS
from offboard.link.log import new_file

Array = NDArray[np.float64]


def _vectors(what: str, unit: str) -> tuple[str, ...]:
    return tuple(f"{what}_{axis}_{unit}" for axis in ("north", "east", "down"))


def _quaternion(what: str) -> tuple[str, ...]:
    return tuple(f"{what}_{part}" for part in "wxyz")


COLUMNS = {
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
_ARRAYS = {"decision": "records"}  # series -> array of History, if its name differs
EVENT = "event"  # source and column of texts
PHASE = "decision_phase"  # column of phase codes, which tables show as names


def read(path: Path) -> History:
    """Read a flight directory or a .tlog file. Raises UserError, also without telemetry."""
    log = tlog.read(path)
    flown = gather(log, unix_times=True)
    if not any(map(len, (flown.position, flown.attitude))):
        raise UserError(f"{log.path} holds no telemetry with a time stamp: nothing to export")
    return flown


def series_of(flown: History) -> dict[str, Rows]:
    """Return the series of a flight that have samples, by their names in COLUMNS. Samples before
    the first telemetry are left out, as they have no vehicle time."""
    arrays = {name: getattr(flown, _ARRAYS.get(name, name)) for name in COLUMNS}
    known = {name: rows[np.isfinite(rows["time_s"])] for name, rows in arrays.items()}
    return {name: rows for name, rows in known.items() if len(rows)}


def events_of(flown: History) -> list[Event]:
    """Return the events of a flight that have a vehicle time."""
    return [event for event in flown.events() if math.isfinite(event.time_s)]


def values_of(rows: Rows) -> Array:
    """Return the values (N, columns) of a series, in the order of COLUMNS."""
    names = [name for name in rows.dtype.names or () if name not in ("time_s", "unix_s")]
    return np.column_stack([rows[name] for name in names]).astype(np.float64)


def samples(name: str, rows: Rows) -> Iterator[tuple[float, float, dict[str, Any]]]:
    """Yield the vehicle time and the Unix time of each sample, and its finite values by column; a
    phase is given by its name."""
    times = rows["time_s"].tolist(), rows["unix_s"].tolist()
    for time_s, unix_s, values in zip(*times, values_of(rows).tolist(), strict=True):
        known = {
            column: PHASES.get(int(value), value) if column == PHASE else value
            for column, value in zip(COLUMNS[name], values, strict=True)
            if math.isfinite(value)
        }
        yield time_s, unix_s, known


def write_csv(flown: History, path: Path) -> None:
    """Write a CSV file in UTF-8 with a line of column names. Raises UserError.

    It has one row for each sample, in the order of vehicle time. `source` is the name of the
    series; columns of other series are empty. Rows with the source `event` have a text in the
    column `event`.
    """
    found = series_of(flown)
    columns = [column for name in found for column in COLUMNS[name]]
    events = (
        _row(e.time_s, e.unix_s, EVENT, {EVENT: f"{e.who}: {e.what}"}) for e in events_of(flown)
    )
    rows = [_csv_rows(name, each) for name, each in found.items()]
    with new_file(path) as file, io.TextIOWrapper(file, "utf-8", newline="") as text:
        writer = csv.DictWriter(text, (*_row(0.0, 0.0, "", {}), *columns, EVENT))
        writer.writeheader()
        writer.writerows(heapq.merge(*rows, events, key=itemgetter("vehicle_time_s")))


def _csv_rows(name: str, rows: Rows) -> Iterator[dict[str, Any]]:
    """Yield one row for each sample, in the order of time."""
    for time_s, unix_s, known in samples(name, rows[np.argsort(rows["time_s"], kind="stable")]):
        yield _row(time_s, unix_s, name, known)


def _row(time_s: float, unix_s: float, source: str, cells: dict[str, Any]) -> dict[str, Any]:
    return {"vehicle_time_s": time_s, "unix_time_s": unix_s, "source": source, **cells}
