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
from typing import Any, TypeVar

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
from offboard.mavlink.senders import DIALECTS, dialect_of, is_vehicle
from offboard.mavlink.session import COMPONENT_ID, RECORD_COMPONENT_ID
from offboard.mavlink.texts import TextAssembler
from offboard.mavlink.vehicle_time import Age, VehicleTime
from offboard.model.frames import quaternion_from_euler
from offboard.model.geodesy import Geodetic, origin_of, position_ned_m

Array = NDArray[np.float64]
Rows = NDArray[np.void]
Kind = TypeVar("Kind", bound=np.generic)
OUR_COMPONENTS = (COMPONENT_ID, RECORD_COMPONENT_ID)
TELEMETRY = (31, 32)  # ATTITUDE_QUATERNION, LOCAL_POSITION_NED
_SUBSTITUTES = (30, 33)  # ATTITUDE, GLOBAL_POSITION_INT: the clock of logs without these
_TUNNEL = 385  # message id
_NO_VOLTAGE, _NO_PERCENTAGE = 0xFFFF, -1  # of SYS_STATUS
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
_TRUTH = {"HIL_STATE_QUATERNION": 1e3, "SIM_STATE": 1.0}  # units of the altitude in a metre
_INSTEAD_OF = {
    "ATTITUDE": "ATTITUDE_QUATERNION",
    "GLOBAL_POSITION_INT": "LOCAL_POSITION_NED",
    "ATTITUDE_TARGET": "SET_ATTITUDE_TARGET",
}
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
_LIMITS = {
    "position_ned_m": POSITION_LIMIT_M,
    "velocity_ned_mps": VELOCITY_LIMIT_MPS,
    "rates_radps": RATE_LIMIT_RADPS,
}
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
    payloads that hold the columns.

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
        self._stamp = (layout(message).names or ("",))[0]
        self.data = bytearray()

    def stamp_ms(self, payload: bytes) -> float | None:
        """The stamp of a message, None without one."""
        if self._stamp == "time_boot_ms":
            return int.from_bytes(payload[:4], "little")
        if self._stamp == "time_usec" and any(payload[:8]):
            return 1e-3 * int.from_bytes(payload[:8], "little")
        return None

    def add(self, payload: bytes, time_s: float, unix_s: float) -> None:
        """A message with its vehicle time, and that of its entry in the log."""
        self.data += _TIMES.pack(time_s, unix_s)
        self.data += payload[self._begin : self._end].ljust(self._end - self._begin, b"\0")

    def rows(self) -> Rows:
        """All rows. Nothing can be added after."""
        return np.frombuffer(self.data, self._dtype)


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


def in_parts(function: Callable[..., NDArray[Kind]], rows: Rows, *more: Any) -> NDArray[Kind]:
    """`function` of all rows, (N, ...), and of `more`."""
    return np.concatenate([function(part, *more) for part in parts(rows)])


class _Collector:
    """Collects the messages of this vehicle and those of `offboard`, which has its system id."""

    def __init__(self, vehicle: Address | None, dialect: Dialect | None) -> None:
        self._vehicle, self._dialect = vehicle, dialect
        self._ours, self._theirs = (
            {name: Samples(name.partition(" ")[0], columns) for name, columns in table.items()}
            for table in (_OURS, _THEIRS)
        )
        self._origin: Geodetic | None = None  # of the local frame
        self._assembler = TextAssembler()
        self._texts: list[Event] = []  # of the vehicle
        self._modes: list[Event] = []
        self._event_records: list[tuple[float, float, bytes]] = []
        self._counts: Counter[str] = Counter()
        self._unix_us = (0, 0)
        self._clocks: tuple[int, ...] = TELEMETRY + _SUBSTITUTES
        self._time = VehicleTime()
        self.now_s = math.nan  # vehicle time of the newest telemetry
        self.damage_s = math.nan  # time of the newest one before the first damage

    def _said(self, what: str, unix_s: float) -> Event:
        return Event(self.now_s, "vehicle", what, unix_s=unix_s)

    def add(self, entry: LoggedMessage) -> None:
        frame, vehicle, name = entry.frame, self._vehicle, entry.name
        payload, unix_s = frame.payload, entry.unix_us / 1e6
        self._counts[name] += 1
        self._unix_us = (self._unix_us[0] or entry.unix_us, entry.unix_us)
        ours = frame.component_id in OUR_COMPONENTS
        if ours and (vehicle is None or frame.system_id == vehicle.system_id):
            name = f"{name} {frame.message.array_id}" if name == _ARRAY else name
        elif (
            ours
            or (frame.system_id, frame.component_id) != vehicle
            or self._is_of_another(entry)
            or not self._follow(frame.message_id, payload)
        ):
            return
        if name == "TIMESYNC" and ours == any(payload[:8]):  # tc1 is 0 in a request
            return  # the delay of the link is that of our requests and their replies
        samples = (self._ours if ours else self._theirs).get(name)
        instead = _INSTEAD_OF.get(name, "")
        usual = self._theirs.get(instead) or self._ours.get(instead)
        if samples and not (usual and usual.data):  # else only memory
            self._keep(samples, payload, unix_s)
        (self._add_ours if ours else self._add_theirs)(entry, payload, unix_s)

    def _is_of_another(self, entry: LoggedMessage) -> bool:
        """The HEARTBEAT of another program with the vehicle's ids, which the flight has ignored."""
        if entry.frame.message_id != HEARTBEAT or not self._dialect:
            return False
        return dialect_of(entry.message) is not self._dialect

    def _keep(self, samples: Samples, payload: bytes, unix_s: float) -> None:
        """A message without a stamp has that of the telemetry before it."""
        stamp_ms = samples.stamp_ms(payload)
        time_s = self.now_s if stamp_ms is None else self._continued_s(stamp_ms)
        samples.add(payload, time_s, unix_s)

    def _continued_s(self, stamp_ms: float) -> float:
        """Vehicle time of a stamp, which begins again at zero after 2^32 ms. Those that do not
        are put on the same clock."""
        return (stamp_ms + 1e3 * self._time.wrapped_s(stamp_ms / 1e3)) / 1e3

    def _follow(self, kind: int, payload: bytes) -> bool:
        """Follow the vehicle's clock, also to its beginning after a restart. False for telemetry
        with a stamp so far ahead that the flight has refused it, too."""
        if kind not in self._clocks:
            return True
        if kind in TELEMETRY:
            self._clocks = TELEMETRY
        time_s = self._continued_s(int.from_bytes(payload[:4], "little"))
        age = self._time.check(kind, time_s)
        if age is Age.REBOOTED and self._event_records:
            self._forget_before_flight()
        if age is Age.STALE and time_s > self._time.newest_s:
            return False
        self.now_s = time_s
        return True

    def _add_ours(self, entry: LoggedMessage, payload: bytes, unix_s: float) -> None:
        if entry.name == "SET_POSITION_TARGET_LOCAL_NED":
            setpoint = payload[:4] + _NO_ATTITUDE
            self._keep(self._ours["SET_ATTITUDE_TARGET"], setpoint, unix_s)
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

    def _forget_before_flight(self) -> None:
        """The vehicle was rebooted, and its time begins anew: if no setpoint was sent yet, what it
        reported before does not belong to the flight."""
        if not self._ours["SET_ATTITUDE_TARGET"].data:
            for samples in self._theirs.values():
                samples.data.clear()

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
        rows = {name: samples.rows() for name, samples in self._theirs.items()}
        ours = {name: samples.rows() for name, samples in self._ours.items()}
        heartbeat, battery = rows["HEARTBEAT"], rows["SYS_STATUS"]
        heartbeat["armed"] = heartbeat["armed"] & ARMED > 0
        voltage, remaining = (battery[name].astype(np.float32) for name in _THEIRS["SYS_STATUS"])
        voltage[voltage == _NO_VOLTAGE] = remaining[remaining == _NO_PERCENTAGE] = math.nan
        position = _plausible(rows["LOCAL_POSITION_NED"])
        attitude = _plausible(rows["ATTITUDE_QUATERNION"])
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
            position = in_parts(_true_position, rows[name], unit, origin)
            return table(rows[name], position_ned_m=position)
    none = {"time_s": np.zeros(0), "unix_s": np.zeros(0)}
    return table(none, position_ned_m=np.zeros((0, 3), np.float32))


def _true_position(rows: Rows, unit: float, origin: Geodetic) -> Array:
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


def _plausible(rows: Rows) -> Rows:
    """Without those that the flight refuses, too; without a copy if there are none."""
    kept = in_parts(_within_limits, rows)
    return rows if kept.all() else rows[kept]


def _within_limits(rows: Rows) -> NDArray[np.bool_]:
    known = rows.dtype.names or ()
    kept = [(np.abs(rows[name]) < _LIMITS[name]).all(axis=1) for name in _LIMITS if name in known]
    if "quaternion" in known:
        lengths = np.linalg.norm(rows["quaternion"], axis=1)
        kept += [lengths > UNIT_LENGTHS[0], lengths < UNIT_LENGTHS[1]]
    within: NDArray[np.bool_] = np.logical_and.reduce(kept)
    return within


def _vehicle(log: Tlog) -> tuple[Address | None, Dialect | None]:
    """The vehicle that its record in the log names, else the first autopilot that was heard."""
    first: tuple[Address | None, Dialect | None] = (None, None)
    for entry in log:
        kind = entry.frame.message_id
        if kind == HEARTBEAT and first[0] is None:
            if is_vehicle(entry.message):
                heard = Address(entry.system_id, entry.component_id)
                first = heard, dialect_of(entry.message)
        elif record_type(entry) == record.VEHICLE_TYPE:
            flown = record.vehicle_of(entry.tunnelled)
            if flown and flown.system_id == entry.system_id:
                found = Address(flown.system_id, flown.component_id)
                return found, DIALECTS.get(flown.autopilot)
    return first
