"""One flight as columns and events, read once from its .tlog.

Times are vehicle time in seconds, continued where `time_boot_ms` begins again at zero. Positions
are NED in metres relative to the estimator's origin. The columns of a message are the bytes of its
payloads as they are in the log; only those that are used are kept.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.tlog import LoggedMessage, Tlog, layout
from offboard.documents.errors import UserError
from offboard.flight import record
from offboard.flight.phases import Phase
from offboard.flight.record import FIELDS, IDENTIFIED_ID, RECORD_ID
from offboard.identification.vehicle_fit import RECORDED
from offboard.mavlink import event_record
from offboard.mavlink.decode import (
    ARMED,
    POSITION_LIMIT_M,
    RATE_LIMIT_RADPS,
    UNIT_LENGTHS,
    VELOCITY_LIMIT_MPS,
    Address,
)
from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.framing import HEARTBEAT
from offboard.mavlink.senders import DIALECTS, is_vehicle
from offboard.mavlink.session import COMPONENT_ID, RECORD_COMPONENT_ID
from offboard.mavlink.texts import TextAssembler
from offboard.mavlink.vehicle_time import Age, VehicleTime
from offboard.model.frames import quaternion_from_euler
from offboard.model.geodesy import Geodetic, origin_of, position_ned_m

Array = NDArray[np.float64]
Rows = NDArray[np.void]
OUR_COMPONENTS = (COMPONENT_ID, RECORD_COMPONENT_ID)
TELEMETRY = (31, 32)  # ATTITUDE_QUATERNION, LOCAL_POSITION_NED
_SUBSTITUTES = (30, 33)  # ATTITUDE, GLOBAL_POSITION_INT: the clock of logs without these
_TUNNEL = 385  # message id
_NO_VOLTAGE, _NO_PERCENTAGE = 0xFFFF, -1  # of SYS_STATUS
_WRAP_MS = 2**32
PHASES: dict[int | None, str] = {phase.code: phase.value for phase in Phase}
# Columns of a message: name -> the first of its fields and how many values, in an array from where
Columns = Mapping[str, tuple[str, int] | tuple[str, int, int]]
_MOTION: Columns = {"position_ned_m": ("x", 3), "velocity_ned_mps": ("vx", 3)}
_SETPOINT: Columns = {"quaternion": ("q", 4), "thrust": ("thrust", 1)}
_TIMESYNC: Columns = {"answered_ns": ("tc1", 1), "asked_ns": ("ts1", 1)}
_THEIRS: dict[str, Columns] = {
    "TIMESYNC": _TIMESYNC,
    "LOCAL_POSITION_NED": _MOTION,
    "ATTITUDE_QUATERNION": {"quaternion": ("q1", 4), "rates_radps": ("rollspeed", 3)},
    "HEARTBEAT": {"armed": ("base_mode", 1), "system_status": ("system_status", 1)},
    "SYS_STATUS": {"voltage": ("voltage_battery", 1), "remaining": ("battery_remaining", 1)},
    "EXTENDED_SYS_STATE": {"state": ("landed_state", 1)},
    # true positions of a simulated vehicle
    "HIL_STATE_QUATERNION": {"place": ("lat", 2), "altitude": ("alt", 1)},
    "SIM_STATE": {"place": ("lat_int", 2), "altitude": ("alt", 1)},
    # what ground stations record instead
    "ATTITUDE": {"angles": ("roll", 3), "rates_radps": ("rollspeed", 3)},
    "GLOBAL_POSITION_INT": {"place": ("lat", 3), "velocity": ("vx", 3)},
    "ATTITUDE_TARGET": _SETPOINT,
}
_INSTEAD_OF = {"ATTITUDE": "ATTITUDE_QUATERNION", "GLOBAL_POSITION_INT": "LOCAL_POSITION_NED"}
_ARRAY = "DEBUG_FLOAT_ARRAY"  # those of ours, with their array_id
_RECORDS, _IDENTIFIED = f"{_ARRAY} {RECORD_ID}", f"{_ARRAY} {IDENTIFIED_ID}"
_OURS: dict[str, Columns] = {
    "POSITION_TARGET_LOCAL_NED": {
        **_MOTION, "acceleration_ned_mps2": ("afx", 3), "heading_rad": ("yaw", 1)
    },
    "SET_ATTITUDE_TARGET": _SETPOINT,
    "TIMESYNC": _TIMESYNC,
    _RECORDS: {name: ("data", 1, place) for place, name in enumerate(FIELDS)},
    _IDENTIFIED: {name: ("data", 2, 2 * place) for place, name in enumerate(RECORDED)},
}  # fmt: skip
_TRUTH = {"HIL_STATE_QUATERNION": 1e3, "SIM_STATE": 1.0}  # units of the altitude in a metre
_NO_ATTITUDE = struct.pack("<8f", *(math.nan,) * 8)  # of a setpoint, after its stamp
_TIMES = struct.Struct("<2d")  # time_s, unix_s


@dataclass(frozen=True, slots=True)
class Event:
    """A phase, a mode or a text: vehicle time (NaN before telemetry), sender, and what. `phase`:
    the one that begins, empty for another event; `cause`: a word for what caused it, or empty;
    `unix_s`: its time in the log."""

    time_s: float
    who: str
    what: str
    phase: str = ""
    cause: str = ""
    unix_s: float = math.nan

    @property
    def stamp(self) -> str:
        """Its vehicle time, empty before telemetry."""
        return "" if math.isnan(self.time_s) else f"{self.time_s:.2f}"

    @property
    def reason(self) -> str:
        """Why its phase begins."""
        return self.what.removeprefix(f"{self.phase}: ")


@dataclass(frozen=True, slots=True)
class History:
    """Structured arrays (N,) in the order of arrival, and events. Each has `time_s`, `unix_s` (the
    time in the log), and:

    position: position_ned_m, velocity_ned_mps (LOCAL_POSITION_NED, or GLOBAL_POSITION_INT, then
        relative to the first one)
    attitude: quaternion (w, x, y, z), rates_radps (ATTITUDE_QUATERNION, or ATTITUDE)
    truth: position_ned_m (HIL_STATE_QUATERNION or SIM_STATE; empty without)
    reference: position, velocity and acceleration, heading_rad (POSITION_TARGET_LOCAL_NED)
    setpoint: quaternion, thrust (SET_ATTITUDE_TARGET); the last two NaN for a setpoint of
        the autopilot's own position loop (SET_POSITION_TARGET_LOCAL_NED)
    commanded: the same, or in a log without ours what the vehicle reports (ATTITUDE_TARGET)
    identified: value and sd of each constant of `identification.vehicle_fit.RECORDED`
    link_delay: delay_s, at the telemetry that a TIMESYNC request followed; without `unix_s`
    heartbeat: armed (1 or 0), system_status (MAV_STATE)
    battery: voltage_mv, remaining in percent; NaN where it is not known (SYS_STATUS)
    landed: state (MAV_LANDED_STATE of EXTENDED_SYS_STATE)
    records: the fields of `flight.record.TickRecord`

    `phases` and `announcements` are our own, by their records; `modes` and `vehicle_messages`
    (STATUSTEXT, refused commands) the vehicle's. `vehicle` is the one that our record of it
    names, else the first autopilot that was heard; only its messages, and ours, are used. `vehicle`
    is None without one, `dialect` also for an autopilot that is not known. `substitutes` are the
    messages that take the place of others in the log of a ground station. `damage` says what could
    not be read, `damage_s` is the time of the telemetry before the first damage, NaN without.
    """

    position: Rows
    attitude: Rows
    truth: Rows
    reference: Rows
    setpoint: Rows
    commanded: Rows
    records: Rows
    identified: Rows
    link_delay: Rows
    heartbeat: Rows
    battery: Rows
    landed: Rows
    phases: tuple[Event, ...]
    announcements: tuple[Event, ...]
    modes: tuple[Event, ...]
    vehicle_messages: tuple[Event, ...]
    vehicle: Address | None
    dialect: Dialect | None
    messages: Counter[str]
    wall_s: float
    substitutes: tuple[str, ...] = ()
    damage: str = ""
    damage_s: float = math.nan

    def events(self) -> list[Event]:
        """Phases, announcements, modes and messages of the vehicle in the order of time; what came
        before any telemetry first."""
        modes = (replace(event, what=f"mode {event.what}") for event in self.modes)
        every = (*self.phases, *self.announcements, *modes, *self.vehicle_messages)
        return sorted(every, key=lambda e: -math.inf if math.isnan(e.time_s) else e.time_s)


def gather(log: Tlog) -> History:
    """Sort a log's messages into a History. A log without a vehicle gives empty arrays."""
    collector = _Collector(*_vehicle(log))
    for entry in log:
        if log.damaged and math.isnan(collector.damage_s):
            collector.damage_s = collector.now_s
        collector.add(entry)
    return collector.history(log.damage)


def configuration(log: Tlog) -> str | None:
    """The configuration of the flight as YAML (see `run.configuration.flown`), None without.
    Raises UserError."""
    pieces = (entry.tunnelled for entry in log if record_type(entry) == record.CONFIGURATION_TYPE)
    try:
        return record.joined_configuration(pieces)
    except ValueError as error:
        raise UserError(f"{log.path}: {error}") from None


def record_type(entry: LoggedMessage) -> int | None:
    """TUNNEL.payload_type of one of our records, None for any other message."""
    if entry.frame.message_id != _TUNNEL or entry.component_id not in OUR_COMPONENTS:
        return None
    return int.from_bytes(entry.frame.payload[:2], "little")


class Samples:
    """Rows of the messages of one kind, in the order of arrival: their time, and the bytes of their
    payloads that hold the columns. A message without a stamp has that of the telemetry before it.

    Args:
        message: name in pymavlink.
        columns: name -> the first of its fields, or an array field, and how many values.
    """

    def __init__(self, message: str, columns: Columns) -> None:
        places = {column: _place(message, *fields) for column, fields in columns.items()}
        self._begin = min(at for at, _ in places.values())
        self._end = max(at + kind.itemsize for at, kind in places.values())
        away = _TIMES.size - self._begin
        self._dtype = np.dtype(
            {
                "names": ["time_s", "unix_s", *places],
                "formats": ["f8", "f8", *(kind for _, kind in places.values())],
                "offsets": [0, 8, *(away + at for at, _ in places.values())],
                "itemsize": away + self._end,
            }
        )
        self._stamps = layout(message).names or ()
        self._data = bytearray()

    @property
    def empty(self) -> bool:
        return not self._data

    def clear(self) -> None:
        self._data.clear()

    def add(self, payload: bytes, now_ms: float, unix_s: float) -> None:
        """A message. `now_ms`: stamp of the telemetry before it, NaN without. `unix_s`: of its
        entry in the log."""
        stamp_ms = now_ms
        if "time_boot_ms" in self._stamps:  # the first field, as is the next
            stamp_ms = int.from_bytes(payload[:4], "little")
        elif "time_usec" in self._stamps and any(payload[:8]):
            stamp_ms = 1e-3 * int.from_bytes(payload[:8], "little")
        self._data += _TIMES.pack(stamp_ms, unix_s)
        self._data += payload[self._begin : self._end].ljust(self._end - self._begin, b"\0")

    def rows(self, anchor_ms: float) -> Rows:
        """All rows, their times continued (see `continuous_s`). Nothing can be added after."""
        rows: Rows = np.frombuffer(self._data, self._dtype)
        rows["time_s"] = continuous_s(rows["time_s"], anchor_ms)
        return rows


def _place(message: str, field: str, count: int, first: int = 0) -> tuple[int, np.dtype[Any]]:
    """Where in the payload values begin, and their type."""
    found = layout(message).fields
    assert found is not None
    kind, at = found[field][:2]
    base = kind.base
    return at + first * base.itemsize, np.dtype((base, (count,))) if count > 1 else base


def table(times: Any, **columns: Any) -> Rows:
    """Rows with both times (N,) of other rows, or of a mapping, and columns (N, ...)."""
    values = {name: np.asarray(column) for name, column in columns.items()}
    values = {name: np.asarray(times[name]) for name in ("time_s", "unix_s")} | values
    kinds = [(name, each.dtype, each.shape[1:]) for name, each in values.items()]
    rows = np.empty(len(values["time_s"]), kinds)
    for name, each in values.items():
        rows[name] = each
    return rows


def parts(values: NDArray[Any]) -> list[NDArray[Any]]:
    """Parts of about 8192 rows. What is computed of a part needs little memory: a log may last
    many hours."""
    return np.array_split(values, 1 + len(values) // 8192)


def in_parts(function: Callable[[Rows], Array], rows: Rows) -> Array:
    """`function` of all rows, (N, ...)."""
    return np.concatenate([function(part) for part in parts(rows)])


def continuous_s(stamps_ms: Any, anchor_ms: float) -> Any:
    """Vehicle time in s from `time_boot_ms`, which begins again at zero after 2^32 ms.

    The result is within 24 days of `anchor_ms`, any stamp of the same log. Stamps that do not wrap
    are put on the same clock.
    """
    if math.isnan(anchor_ms):
        return stamps_ms / 1e3
    away_ms = (stamps_ms - anchor_ms + _WRAP_MS / 2) % _WRAP_MS - _WRAP_MS / 2
    return (anchor_ms + away_ms) / 1e3


class _Collector:
    """Collects the messages of this vehicle and those of `offboard`, which has its system id."""

    def __init__(self, vehicle: Address | None, dialect: Dialect | None) -> None:
        self._vehicle, self._dialect = vehicle, dialect
        tables = ((True, _OURS), (False, _THEIRS))
        self._samples = {
            (ours, name): Samples(name.partition(" ")[0], columns)
            for ours, table in tables
            for name, columns in table.items()
        }
        self._origin: Geodetic | None = None  # of the local frame
        self._assembler = TextAssembler()
        self._texts: list[Event] = []  # of the vehicle
        self._modes: list[Event] = []
        self._event_records: list[tuple[float, float, bytes]] = []
        self._counts: Counter[str] = Counter()
        self._unix_us = (0, 0)
        self._anchor_ms = math.nan
        self._clocks: tuple[int, ...] = TELEMETRY + _SUBSTITUTES
        self._time = VehicleTime()
        self._now_ms = math.nan  # stamp of the newest telemetry
        self.damage_s = math.nan  # time of the newest one before the first damage

    @property
    def now_s(self) -> float:
        """Vehicle time of the newest telemetry, NaN before it."""
        return float(continuous_s(self._now_ms, self._anchor_ms))

    def _said(self, what: str, unix_s: float) -> Event:
        return Event(self.now_s, "vehicle", what, unix_s=unix_s)

    def add(self, entry: LoggedMessage) -> None:
        self._counts[entry.name] += 1
        self._unix_us = (self._unix_us[0] or entry.unix_us, entry.unix_us)
        payload, vehicle, name = entry.frame.payload, self._vehicle, entry.name
        ours = entry.component_id in OUR_COMPONENTS
        if ours and (vehicle is None or entry.system_id == vehicle.system_id):
            name = f"{name} {entry.message.array_id}" if name == _ARRAY else name
        elif ours or (entry.system_id, entry.component_id) != vehicle or not self._accept(entry):
            return
        if name == "TIMESYNC" and ours == any(payload[:8]):  # tc1 is 0 in a request
            return  # the delay of the link is that of our requests and their replies
        usual = self._samples.get((ours, _INSTEAD_OF.get(name, "")))
        if (ours, name) in self._samples and (usual is None or usual.empty):  # else only memory
            self._samples[ours, name].add(payload, self._now_ms, entry.unix_us / 1e6)
        (self._add_ours if ours else self._add_theirs)(entry, payload, entry.unix_us / 1e6)

    def _add_ours(self, entry: LoggedMessage, payload: bytes, unix_s: float) -> None:
        if entry.name == "SET_POSITION_TARGET_LOCAL_NED":
            setpoint = payload[:4] + _NO_ATTITUDE
            self._samples[True, "SET_ATTITUDE_TARGET"].add(setpoint, self._now_ms, unix_s)
        elif record_type(entry) == event_record.EVENT_TYPE:
            self._event_records.append((self.now_s, unix_s, entry.tunnelled))

    def _add_theirs(self, entry: LoggedMessage, payload: bytes, unix_s: float) -> None:
        name = entry.name
        if name == "STATUSTEXT":
            whole = self._assembler.add(payload, unix_s)
            self._texts += [self._said(text.text, unix_s) for text in whole]
        elif name == "COMMAND_ACK":
            command, result = entry.message.command, entry.message.result
            if result not in (0, 5):  # MAV_RESULT_ACCEPTED, MAV_RESULT_IN_PROGRESS
                refused = f"command {command} refused, result {result}"
                self._texts.append(self._said(refused, unix_s))
        elif name in ("GPS_GLOBAL_ORIGIN", "HOME_POSITION"):
            self._add_origin(entry)
        if name == "HEARTBEAT" and self._dialect:
            mode = self._dialect.mode_name(int.from_bytes(payload[:4], "little"))
            if not self._modes or mode != self._modes[-1].what:
                self._modes.append(self._said(mode, unix_s))
        if entry.frame.message_id in self._clocks:
            if entry.frame.message_id in TELEMETRY:
                self._clocks = TELEMETRY
            self._now_ms = float(int.from_bytes(payload[:4], "little"))
            if math.isnan(self._anchor_ms):
                self._anchor_ms = self._now_ms

    def _accept(self, entry: LoggedMessage) -> bool:
        """Follow the vehicle's clock, also to its beginning after a restart. False for what the
        flight has refused, too: telemetry with a stamp so far ahead, and the HEARTBEAT of another
        program with the vehicle's ids."""
        if entry.frame.message_id == HEARTBEAT and self._dialect:
            own = entry.message.autopilot == self._dialect.mav_autopilot
            return own and is_vehicle(entry.message)
        if entry.frame.message_id not in TELEMETRY:
            return True
        time_s = int.from_bytes(entry.frame.payload[:4], "little") / 1e3
        time_s += self._time.wrapped_s(time_s)
        age = self._time.check(entry.frame.message_id, time_s)
        if age is Age.REBOOTED and self._event_records:
            self._forget_before_flight()
        return age is not Age.STALE or time_s <= self._time.newest_s

    def _forget_before_flight(self) -> None:
        """The vehicle was rebooted, and its time begins anew: if no setpoint was sent yet, what it
        reported before does not belong to the flight."""
        if self._samples[True, "SET_ATTITUDE_TARGET"].empty:
            for (ours, _), samples in self._samples.items():
                if not ours:
                    samples.clear()

    def _add_origin(self, entry: LoggedMessage) -> None:
        """HOME_POSITION gives one point in both frames."""
        at = entry.message
        place = Geodetic(at.latitude / 1e7, at.longitude / 1e7, at.altitude / 1e3)
        if entry.name == "GPS_GLOBAL_ORIGIN":
            self._origin = place
        elif self._origin is None:  # else of no use: ArduCopter's x, y and z are zero
            self._origin = origin_of(place, (at.x, at.y, at.z))

    def history(self, damage: str) -> History:
        """All that was added."""
        found = {key: samples.rows(self._anchor_ms) for key, samples in self._samples.items()}
        rows = {name: found[False, name] for name in _THEIRS}
        ours = {name: found[True, name] for name in _OURS}
        heartbeat, battery = rows["HEARTBEAT"], rows["SYS_STATUS"]
        heartbeat["armed"] = heartbeat["armed"] & ARMED > 0
        voltage, remaining = (battery[name].astype(np.float32) for name in _THEIRS["SYS_STATUS"])
        voltage[voltage == _NO_VOLTAGE] = remaining[remaining == _NO_PERCENTAGE] = math.nan
        position = _plausible(
            rows["LOCAL_POSITION_NED"],
            position_ned_m=POSITION_LIMIT_M,
            velocity_ned_mps=VELOCITY_LIMIT_MPS,
        )
        attitude = _plausible(rows["ATTITUDE_QUATERNION"], rates_radps=RATE_LIMIT_RADPS)
        lengths = np.linalg.norm(attitude["quaternion"], axis=1)
        attitude = _where(attitude, lengths > UNIT_LENGTHS[0], lengths < UNIT_LENGTHS[1])
        setpoint = ours["SET_ATTITUDE_TARGET"]
        substitutes = []
        if not len(position) and not len(ours["POSITION_TARGET_LOCAL_NED"]):  # of another origin
            position = _position_of_global(rows["GLOBAL_POSITION_INT"])
            substitutes.append("GLOBAL_POSITION_INT")
        if not len(attitude):
            attitude = _attitude_of_angles(rows["ATTITUDE"])
            substitutes.append("ATTITUDE")
        if not len(setpoint):
            substitutes.append("ATTITUDE_TARGET")
        events = []
        for last, event in event_record.join(payload for *_, payload in self._event_records):
            time_s, unix_s, _ = self._event_records[last]
            phase = PHASES.get(event.phase, "")
            events.append(Event(time_s, "offboard", event.text, phase, event.cause, unix_s))
        return History(
            position=position,
            attitude=attitude,
            truth=_truth(rows, self._origin),
            reference=ours["POSITION_TARGET_LOCAL_NED"],
            setpoint=setpoint,
            commanded=setpoint if len(setpoint) else rows["ATTITUDE_TARGET"],
            records=ours[_RECORDS],
            identified=ours[_IDENTIFIED],
            link_delay=_link_delay(ours["TIMESYNC"], rows["TIMESYNC"]),
            heartbeat=heartbeat,
            battery=table(battery, voltage_mv=voltage, remaining=remaining),
            landed=rows["EXTENDED_SYS_STATE"],
            phases=tuple(event for event in events if event.phase),
            announcements=tuple(event for event in events if not event.phase),
            modes=tuple(self._modes),
            vehicle_messages=tuple(self._texts),
            vehicle=self._vehicle,
            dialect=self._dialect,
            messages=self._counts,
            wall_s=(self._unix_us[1] - self._unix_us[0]) / 1e6,
            substitutes=tuple(substitutes),
            damage=damage,
            damage_s=self.damage_s,
        )


def _truth(rows: Mapping[str, Rows], origin: Geodetic | None) -> Rows:
    for name, unit in _TRUTH.items():
        if origin is not None and len(rows[name]):
            position = partial(_true_position, unit=unit, origin=origin)
            return table(rows[name], position_ned_m=in_parts(position, rows[name]))
    none = {"time_s": np.zeros(0), "unix_s": np.zeros(0)}
    return table(none, position_ned_m=np.zeros((0, 3), np.float32))


def _true_position(rows: Rows, *, unit: float, origin: Geodetic) -> Array:
    """NED in m (N, 3), as float32. `unit` of the altitude in a metre."""
    places = np.column_stack((rows["place"] / 1e7, rows["altitude"] / unit))
    return position_ned_m(places, origin).astype(np.float32)


def _position_of_global(rows: Rows) -> Rows:
    """Positions of GLOBAL_POSITION_INT relative to the first. 1e-7 deg, mm, cm/s."""
    places = rows["place"] / (1e7, 1e7, 1e3)
    position = position_ned_m(places, Geodetic(*places[0].tolist())) if len(rows) else places
    return table(
        rows,
        position_ned_m=position.astype(np.float32),
        velocity_ned_mps=(rows["velocity"] / 100.0).astype(np.float32),
    )


def _attitude_of_angles(rows: Rows) -> Rows:
    """Attitudes from the Euler angles of ATTITUDE."""
    quaternion = quaternion_from_euler(*rows["angles"].astype(np.float64).T)
    rates = rows["rates_radps"]
    return table(rows, quaternion=np.asarray(quaternion, np.float32), rates_radps=rates)


def _link_delay(requests: Rows, replies: Rows) -> Rows:
    """From the vehicle's replies to our TIMESYNC requests."""
    replies = replies[np.isin(replies["asked_ns"], requests["asked_ns"])]
    times = {"time_s": 1e-9 * replies["asked_ns"], "unix_s": np.full(len(replies), np.nan)}
    return table(times, delay_s=1e-9 * (replies["answered_ns"] - replies["asked_ns"]))


def _plausible(rows: Rows, **limits: float) -> Rows:
    """The rows whose columns are within these limits, as the flight refuses the others."""
    return _where(
        rows, *((np.abs(rows[name]) < limit).all(axis=1) for name, limit in limits.items())
    )


def _where(rows: Rows, *conditions: NDArray[np.bool_]) -> Rows:
    """The rows where all conditions (N,) hold; without a copy if that is everywhere."""
    kept = np.all(conditions, axis=0)
    return rows if kept.all() else rows[kept]


def _vehicle(log: Tlog) -> tuple[Address | None, Dialect | None]:
    """The vehicle that its record in the log names, else the first autopilot that was heard."""
    known = {dialect.mav_autopilot: dialect for dialect in DIALECTS.values()}
    first: tuple[Address | None, Dialect | None] = (None, None)
    for entry in log:
        kind = entry.frame.message_id
        if kind == HEARTBEAT and first[0] is None:
            if is_vehicle(entry.message):
                heard = Address(entry.system_id, entry.component_id)
                first = heard, known.get(entry.message.autopilot)
        elif record_type(entry) == record.VEHICLE_TYPE:
            flown = record.vehicle_of(entry.tunnelled)
            if flown and flown.system_id == entry.system_id:
                found = Address(flown.system_id, flown.component_id)
                return found, DIALECTS.get(flown.autopilot)
    return first
