"""The columns of a log: which fields of which messages are kept, and what is computed from them.

A row is one message: its times, then the bytes of its payload as they are in the log, from the
first to the last field that is used.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.tlog import layout
from offboard.flight import record
from offboard.flight.record import FIELDS
from offboard.mavlink.decode import (
    POSITION_LIMIT_M,
    RATE_LIMIT_RADPS,
    UNIT_LENGTHS,
    VELOCITY_LIMIT_MPS,
)
from offboard.model.frames import quaternion_from_euler
from offboard.model.geodesy import Geodetic, position_ned_m

Array = NDArray[np.float64]
Rows = NDArray[np.void]
Kind = TypeVar("Kind", bound=np.generic)
# Columns of a message: name -> its first field, the number of values and, if that field is an
# array, the index of the first value
Columns = Mapping[str, tuple[str, int] | tuple[str, int, int]]

ARRAY = "DEBUG_FLOAT_ARRAY"  # array_id tells our two kinds apart
RECORDS, IDENTIFIED = f"{ARRAY} {record.RECORD_ID}", f"{ARRAY} {record.IDENTIFIED_ID}"
_MOTION: Columns = {"position_ned_m": ("x", 3), "velocity_ned_mps": ("vx", 3)}
_SETPOINT: Columns = {"quaternion": ("q", 4), "thrust": ("thrust", 1)}
_TIMESYNC: Columns = {"answered_ns": ("tc1", 1), "asked_ns": ("ts1", 1)}
THEIRS: dict[str, Columns] = {
    "TIMESYNC": _TIMESYNC,
    "LOCAL_POSITION_NED": _MOTION,
    "ATTITUDE_QUATERNION": {"quaternion": ("q1", 4), "rates_radps": ("rollspeed", 3)},
    "HEARTBEAT": {"armed": ("base_mode", 1), "system_status": ("system_status", 1)},
    "SYS_STATUS": {"voltage": ("voltage_battery", 1), "remaining": ("battery_remaining", 1)},
    "EXTENDED_SYS_STATE": {"state": ("landed_state", 1)},
    # true positions of a simulated vehicle
    "HIL_STATE_QUATERNION": {"place": ("lat", 2), "altitude": ("alt", 1)},
    "SIM_STATE": {"place": ("lat_int", 2), "altitude": ("alt", 1)},
    # used if the log of a ground station lacks the messages of _INSTEAD_OF (history.py)
    "ATTITUDE": {"angles": ("roll", 3), "rates_radps": ("rollspeed", 3)},
    "GLOBAL_POSITION_INT": {"place": ("lat", 3), "velocity": ("vx", 3)},
    "ATTITUDE_TARGET": _SETPOINT,
}
OURS: dict[str, Columns] = {
    "POSITION_TARGET_LOCAL_NED": {
        **_MOTION, "acceleration_ned_mps2": ("afx", 3), "heading_rad": ("yaw", 1)
    },
    "SET_ATTITUDE_TARGET": _SETPOINT,
    "TIMESYNC": _TIMESYNC,
    RECORDS: {name: ("data", 1, place) for place, name in enumerate(FIELDS)},
    IDENTIFIED: {name: ("data", 2, 2 * place) for place, name in enumerate(record.IDENTIFIED)},
}  # fmt: skip
_TIMES = ("time_s", "unix_s")
_TRUTH = {"HIL_STATE_QUATERNION": 1e3, "SIM_STATE": 1.0}  # altitude units per metre
_NO_VOLTAGE, _NO_PERCENTAGE = 0xFFFF, -1  # in SYS_STATUS: the autopilot does not send the value
_LIMITS = {
    "position_ned_m": POSITION_LIMIT_M,
    "velocity_ned_mps": VELOCITY_LIMIT_MPS,
    "rates_radps": RATE_LIMIT_RADPS,
}


class Samples:
    """Rows of the messages of one kind, in the order of arrival.

    Args:
        kind: name of the message in pymavlink; what follows a space is ignored.
        columns: the columns to keep.
        unix_times: whether to keep the Unix time of the log entry, too.
    """

    def __init__(self, kind: str, columns: Columns, *, unix_times: bool) -> None:
        message = layout(kind.partition(" ")[0])
        places = {column: _place(message, *fields) for column, fields in columns.items()}
        times = _TIMES[: 1 + unix_times]
        self._stamp = (message.names or ("",))[0]
        self._begin = min(at for at, _ in places.values())
        self._end = max(at + values.itemsize for at, values in places.values())
        self._times_size = 8 * len(times)
        away = self._times_size - self._begin
        self._dtype = np.dtype(
            {
                "names": [*times, *places],
                "formats": [*("f8" for _ in times), *(values for _, values in places.values())],
                "offsets": [
                    *range(0, self._times_size, 8),
                    *(away + at for at, _ in places.values()),
                ],
                "itemsize": away + self._end,
            }
        )
        self.data = bytearray()

    def stamp_ms(self, payload: bytes) -> float | None:
        """Return `time_boot_ms`, or a `time_usec` other than 0, in ms; None without either."""
        if self._stamp == "time_boot_ms":
            return int.from_bytes(payload[:4], "little")
        if self._stamp == "time_usec" and any(payload[:8]):
            return 1e-3 * int.from_bytes(payload[:8], "little")
        return None

    def add(self, payload: bytes, time_s: float, unix_s: float) -> None:
        """Add a message, its vehicle time and the Unix time of its log entry."""
        self.data += struct.pack("<2d", time_s, unix_s)[: self._times_size]
        self.data += payload[self._begin : self._end].ljust(self._end - self._begin, b"\0")

    def rows(self) -> Rows:
        """Return all rows. Nothing can be added afterwards."""
        return np.frombuffer(self.data, self._dtype)


def _place(
    message: np.dtype[np.void], field: str, count: int, first: int = 0
) -> tuple[int, np.dtype[Any]]:
    """Return the offset in bytes at which a column begins in the payload, and its type."""
    assert message.fields is not None
    kind, at = message.fields[field][:2]
    base = kind.base
    return at + first * base.itemsize, np.dtype((base, (count,))) if count > 1 else base


def table(rows: Rows, **columns: Any) -> Rows:
    """Return rows with the times of `rows` and the given columns (N, ...)."""
    times = {name: rows[name] for name in _TIMES if name in (rows.dtype.names or ())}
    values = {name: np.asarray(column) for name, column in (times | columns).items()}
    made = np.empty(
        len(rows), [(name, each.dtype, each.shape[1:]) for name, each in values.items()]
    )
    for name, each in values.items():
        made[name] = each
    return made


def parts(values: NDArray[Any]) -> list[NDArray[Any]]:
    """Split `values` into parts of about 8192 rows, so that computations on a log of many hours
    need little memory."""
    return np.array_split(values, 1 + len(values) // 8192)


def in_parts(function: Callable[..., NDArray[Kind]], rows: Rows, *more: Any) -> NDArray[Kind]:
    """Return `function(rows, *more)`, (N, ...), computed part by part."""
    return np.concatenate([function(part, *more) for part in parts(rows)])


# ---------------------------------------------------------------------- computed from messages


def truth(rows: Mapping[str, Rows], origin: Geodetic | None) -> Rows:
    """Return the true positions of a simulated vehicle; no rows if the log has none, or without an
    origin."""
    kind, unit = next((each for each in _TRUTH.items() if len(rows[each[0]])), ("SIM_STATE", 1.0))
    known = rows[kind] if origin else rows[kind][:0]
    placed = known["place"].any(axis=1)  # in MAVLink 1 SIM_STATE has no lat_int and lon_int
    known = known if placed.all() else known[placed]
    return table(
        known, position_ned_m=in_parts(_true_position, known, unit, origin or Geodetic(0, 0))
    )


def _true_position(rows: Rows, unit: float, origin: Geodetic) -> Array:
    """Return positions NED in m (N, 3), as float32. `unit`: units of the altitude per metre."""
    places = np.column_stack((rows["place"] / 1e7, rows["altitude"] / unit))
    return position_ned_m(places, origin).astype(np.float32)


def position_of_global(rows: Rows) -> Rows:
    """Convert GLOBAL_POSITION_INT (1e-7 deg, mm, cm/s) to NED, relative to the first position."""
    places = rows["place"] / (1e7, 1e7, 1e3)
    position = position_ned_m(places, Geodetic(*places[0].tolist())) if len(rows) else places
    return table(
        rows,
        position_ned_m=position.astype(np.float32),
        velocity_ned_mps=(rows["velocity"] / 100.0).astype(np.float32),
    )


def attitude_of_angles(rows: Rows) -> Rows:
    """Attitudes from the Euler angles of ATTITUDE."""
    quaternion = quaternion_from_euler(*rows["angles"].astype(np.float64).T)
    rates = rows["rates_radps"]
    return table(rows, quaternion=np.asarray(quaternion, np.float32), rates_radps=rates)


def battery(rows: Rows) -> Rows:
    """Return voltage and remaining charge from SYS_STATUS; NaN where the autopilot sends none."""
    voltage, remaining = (rows[name].astype(np.float32) for name in THEIRS["SYS_STATUS"])
    voltage[voltage == _NO_VOLTAGE] = remaining[remaining == _NO_PERCENTAGE] = math.nan
    return table(rows, voltage_mv=voltage, remaining=remaining)


def link_delay(ours: Rows, theirs: Rows) -> Rows:
    """Return the delays of the link from the vehicle's replies to our TIMESYNC requests.

    A request (tc1 = 0) has in ts1 the stamp of the newest telemetry; the reply returns ts1 and has
    in tc1 the vehicle time at which the request arrived.
    """
    replies = theirs[theirs["answered_ns"] != 0]
    asked_ns = ours["asked_ns"][ours["answered_ns"] == 0]
    replies = replies[np.isin(replies["asked_ns"], asked_ns)]
    delay_s = 1e-9 * (replies["answered_ns"] - replies["asked_ns"])
    return table(replies, time_s=1e-9 * replies["asked_ns"], delay_s=delay_s)


def plausible(rows: Rows) -> Rows:
    """Return the rows with values within the limits of `mavlink.decode`, beyond which the flight
    ignores a message, too. Makes no copy if these are all rows."""
    kept = in_parts(_within_limits, rows)
    return rows if kept.all() else rows[kept]


def _within_limits(rows: Rows) -> NDArray[np.bool_]:
    known = rows.dtype.names or ()
    kept = [(np.abs(rows[name]) < _LIMITS[name]).all(axis=1) for name in _LIMITS if name in known]
    if "quaternion" in known:
        lengths = np.linalg.norm(rows["quaternion"].astype(np.float64), axis=1)
        kept += [lengths > UNIT_LENGTHS[0], lengths < UNIT_LENGTHS[1]]
    within: NDArray[np.bool_] = np.logical_and.reduce(kept)
    return within
