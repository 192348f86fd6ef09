"""Series: a flight as named columns over vehicle time, with the unit in each name.

The frame is NED, the body's is FRD, quaternions are w, x, y, z from NED to FRD, thrust without a
unit is normalised.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from offboard.analysis import history, tlog
from offboard.analysis.history import TELEMETRY, Event, Rows, continuous_s
from offboard.analysis.tlog import Tlog
from offboard.documents.errors import UserError
from offboard.flight.phases import PHASE_CODES
from offboard.flight.record import FIELDS
from offboard.mavlink.decode import Address

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
PHASE = "decision_phase"  # whose numbers tables show as names
LOCKSTEP_SHARE = 0.05  # of the vehicle's time, by which a flight in real time differs at most
_PHASES: dict[int, str] = {code: phase.value for phase, code in PHASE_CODES.items()}
_AUTOPILOTS = {"px4": "PX4", "ardupilot": "ArduPilot"}  # as MAV_AUTOPILOT names them


def phase_name(number: float) -> str:
    """The name of a phase in the column PHASE."""
    return _PHASES[int(number)]


@dataclass(frozen=True, slots=True)
class Series:
    """Samples of one kind: `time_s` (N,) of vehicle time, `values` (N, len(columns))."""

    name: str
    columns: tuple[str, ...]
    time_s: Array
    values: Array


@dataclass(frozen=True, slots=True)
class Flight:
    """`series` in which something was recorded, by name; `events` in the order of time.

    `unix` converts vehicle time to Unix time: stamps of telemetry, (N, 2) in s, both increasing.
    `damage` says what of the log could not be read.
    """

    series: dict[str, Series]
    events: tuple[Event, ...]
    unix: Array
    autopilot: str
    damage: str

    @property
    def in_real_time(self) -> bool:
        """Whether vehicle time and Unix time passed alike: not so in lockstep."""
        vehicle_s, unix_s = np.ptp(self.unix, axis=0).tolist()
        return bool(abs(unix_s - vehicle_s) <= LOCKSTEP_SHARE * vehicle_s)

    def unix_s(self, time_s: Array | float) -> Array:
        """Unix time at which telemetry with this vehicle time was recorded."""
        times = np.asarray(time_s, dtype=np.float64)
        known, stamps = self.unix.T
        outside = np.where(times < known[0], times - known[0], np.maximum(times - known[-1], 0.0))
        converted: Array = np.interp(times, known, stamps) + outside
        return converted


def read(path: Path) -> Flight:
    """The flight in a directory or .tlog. Raises TlogError, or UserError without telemetry."""
    log = tlog.read(tlog.find(path))
    flown = history.gather(log)
    unix = _unix(log, flown.vehicle)
    if not len(unix):
        raise UserError(f"{log.path} holds no telemetry with a time stamp: nothing to export")
    events = tuple(event for event in flown.events() if np.isfinite(event.time_s))
    arrays = {name: getattr(flown, _ARRAYS.get(name, name)) for name in _COLUMNS}
    series = {name: each for name in arrays if len((each := _series(name, arrays[name])).time_s)}
    autopilot = _AUTOPILOTS[flown.dialect.name] if flown.dialect else "unknown"
    return Flight(series, events, unix, autopilot, flown.damage)


def _series(name: str, rows: Rows) -> Series:
    """Without the samples from before any telemetry, whose time is NaN."""
    rows = rows[np.isfinite(rows["time_s"])]
    times = ("time_s", "unix_s")
    columns = [rows[column] for column in rows.dtype.names or () if column not in times]
    return Series(name, _COLUMNS[name], rows["time_s"], np.column_stack(columns))


def _unix(log: Tlog, vehicle: Address | None) -> Array:
    """Vehicle time and Unix time of the vehicle's telemetry, each newer than the one before."""
    rows = [
        (int.from_bytes(message.frame.payload[:4], "little"), message.unix_us / 1e6)
        for message in log
        if message.frame.message_id in TELEMETRY
        and (message.system_id, message.component_id) == vehicle
    ]
    stamps = np.reshape(rows, (-1, 2)).astype(np.float64)
    if len(stamps):
        stamps[:, 0] = continuous_s(stamps[:, 0], stamps[0, 0])
        newest = np.maximum.accumulate(stamps, axis=0)
        stamps = newest[np.r_[True, np.diff(newest[:, 0]) > 0.0]]
    return stamps
