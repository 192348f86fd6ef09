"""One flight as columns and events, read once from its .tlog.

Times are vehicle time in seconds, continued where `time_boot_ms` begins again at zero. Positions
are NED in metres relative to the estimator's origin.
"""

from __future__ import annotations

import math
import struct
from array import array
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.events import Event, Texts, ours
from offboard.analysis.samples import BOOT_US, Rows, Samples, Wire, continuous_s
from offboard.analysis.tlog import LoggedMessage, Tlog, TlogError, columns
from offboard.flight import inputs
from offboard.flight.record import (
    COMPONENT_ID,
    FIELDS,
    IDENTIFIED_ID,
    IDENTIFIED_NAME,
    RECORD_COMPONENT_ID,
    RECORD_NAME,
    records_of,
)
from offboard.identification.vehicle_fit import RECORDED
from offboard.mavlink import event_record
from offboard.mavlink.decode import Address, decode_identity
from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.framing import HEARTBEAT
from offboard.mavlink.senders import DIALECTS, is_vehicle
from offboard.model.geodesy import Geodetic, origin_of, position_ned_m

Array = NDArray[np.float64]
OUR_COMPONENTS = (COMPONENT_ID, RECORD_COMPONENT_ID)
TELEMETRY = (31, 32)  # ATTITUDE_QUATERNION, LOCAL_POSITION_NED
_SUBSTITUTES = (30, 33)  # ATTITUDE, GLOBAL_POSITION_INT: the clock of logs without these
_TUNNEL = 385  # message id
_ARMED = 0x80  # MAV_MODE_FLAG_SAFETY_ARMED

_TIME = ("time_s", "f8")
POSITION = [_TIME, ("position_ned_m", "3f4"), ("velocity_ned_mps", "3f4")]
ATTITUDE = [_TIME, ("quaternion", "4f4"), ("rates_radps", "3f4")]
SETPOINT = [_TIME, ("unix_s", "f8"), ("quaternion", "4f4"), ("thrust", "f4")]
# array of History -> its columns
_DTYPES = {
    "position": POSITION,
    "attitude": ATTITUDE,
    "reference": [
        *POSITION, ("acceleration_ned_mps2", "3f4"), ("heading_rad", "f4"),
    ],
    "setpoint": SETPOINT,
    "heartbeat": [_TIME, ("armed", "f4"), ("system_status", "f4")],
    "battery": [_TIME, ("voltage_mv", "f4"), ("remaining", "f4")],
    "landed": [_TIME, ("state", "f4")],
    "identified": [_TIME, ("values", f"{2 * len(RECORDED)}f4")],
}  # fmt: skip
_MOTION = {"position_ned_m": "x y z", "velocity_ned_mps": "vx vy vz"}
_ROTATION = {"quaternion": "q1 q2 q3 q4", "rates_radps": "rollspeed pitchspeed yawspeed"}
_REFERENCE = {**_MOTION, "acceleration_ned_mps2": "afx afy afz", "heading_rad": "yaw"}
_MODE = {"armed": "base_mode", "system_status": "system_status"}
_BATTERY = {"voltage_mv": "voltage_battery", "remaining": "battery_remaining"}


def _kept(*kinds: tuple[str, Wire]) -> dict[str, tuple[str, Wire]]:
    return {wire.name: (kind, wire) for kind, wire in kinds}


# array of History and fields of its columns, by message
_THEIRS = _kept(
    ("position", Wire("LOCAL_POSITION_NED", _MOTION)),
    ("attitude", Wire("ATTITUDE_QUATERNION", _ROTATION)),
    ("heartbeat", Wire("HEARTBEAT", _MODE, None)),
    ("battery", Wire("SYS_STATUS", _BATTERY, None)),
    ("landed", Wire("EXTENDED_SYS_STATE", {"state": "landed_state"}, None)),
)
_OURS = _kept(
    ("reference", Wire("POSITION_TARGET_LOCAL_NED", _REFERENCE)),
    ("setpoint", Wire("SET_ATTITUDE_TARGET", {"quaternion": "q", "thrust": "thrust"})),
    ("setpoint", Wire("SET_POSITION_TARGET_LOCAL_NED", {})),
)
_PLACE = {"place": "lat lon alt"}
_HIL = Wire("HIL_STATE_QUATERNION", _PLACE, BOOT_US)
_HIL_UNSTAMPED = Wire("HIL_STATE_QUATERNION", _PLACE, None)
_SIM = Wire("SIM_STATE", {"place": "lat_int lon_int alt"}, None)
_SCALES = {_HIL.name: (1e7, 1e7, 1e3), _SIM.name: (1e7, 1e7, 1.0)}
_ARRAYS = {RECORD_NAME.encode(), IDENTIFIED_NAME.encode()}
_TICK = Wire("DEBUG_FLOAT_ARRAY", {}, BOOT_US)
_IDENTIFIED = Wire("DEBUG_FLOAT_ARRAY", {"values": "data"}, BOOT_US)


@dataclass(frozen=True, slots=True)
class History:
    """Structured arrays (N,) in the order of arrival, and events. Each has `time_s`, and:

    position: position_ned_m, velocity_ned_mps (LOCAL_POSITION_NED)
    attitude: quaternion (w, x, y, z), rates_radps (ATTITUDE_QUATERNION)
    truth: position_ned_m (HIL_STATE_QUATERNION or SIM_STATE; empty without)
    reference: position, velocity and acceleration, heading_rad (POSITION_TARGET_LOCAL_NED)
    setpoint: unix_s, quaternion, thrust (SET_ATTITUDE_TARGET); the last two NaN for a setpoint of
        the autopilot's own position loop (SET_POSITION_TARGET_LOCAL_NED)
    identified: value and sd of each constant of `identification.vehicle_fit.RECORDED`
    link_delay: delay_s, at the telemetry that a TIMESYNC request followed
    heartbeat: armed (1 or 0), system_status (MAV_STATE)
    battery: voltage_mv, remaining in percent; NaN where it is not known (SYS_STATUS)
    landed: state (MAV_LANDED_STATE of EXTENDED_SYS_STATE)
    records: the fields of `flight.record.TickRecord`

    `phases` and `announcements` are our own, by their records; `modes` and `vehicle_messages`
    (STATUSTEXT, refused commands) the vehicle's. `vehicle` is the one that was flown, as the log's
    manifest says; in an older log the first autopilot that was heard. Only its messages, and ours,
    are used. It and `dialect` are None without one, `dialect` also for one that is not known.
    `damage` says what could not be read, `damage_s` is the time of the telemetry before the first
    damage, NaN without.
    """

    position: Rows
    attitude: Rows
    truth: Rows
    reference: Rows
    setpoint: Rows
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
        if log.damaged and math.isnan(collector.damage_ms):
            collector.damage_ms = collector.now_ms
        collector.add(entry)
    return collector.history(log.damage)


def configuration(log: Tlog) -> str | None:
    """The configuration of the flight as YAML (see `run.configuration.flown`), None without.
    Raises TlogError."""
    pieces = (entry.tunnelled for entry in log if record_type(entry) == inputs.CONFIGURATION_TYPE)
    try:
        return inputs.join(pieces)
    except ValueError as error:
        raise TlogError(f"{log.path}: {error}") from None


def record_type(entry: LoggedMessage) -> int | None:
    """TUNNEL.payload_type of one of our records, None for any other message."""
    if entry.frame.message_id != _TUNNEL or entry.component_id not in OUR_COMPONENTS:
        return None
    return int.from_bytes(entry.frame.payload[:2], "little")


class _Ticks(Samples):
    """Records of the ticks, of any version."""

    def fill(self, rows: Rows, wire: Wire, payloads: bytearray) -> None:
        ids = columns(wire.name, payloads, "array_id")[:, 0]
        records = records_of(columns(wire.name, payloads, "data"), ids)
        for name in FIELDS:
            rows[name] = records[name]


class _Truth(Samples):
    """True positions from the first known origin of the local frame on. HOME_POSITION gives one
    point in both frames."""

    origin: Geodetic | None = None

    def move(self, origin: Geodetic) -> None:
        self.convert()
        self.origin = origin

    def fill(self, rows: Rows, wire: Wire, payloads: bytearray) -> None:
        assert self.origin is not None
        places = columns(wire.name, payloads, wire.fields["place"]) / _SCALES[wire.name]
        rows["position_ned_m"] = position_ned_m(places, self.origin)


class _Collector:
    """Collects the messages of this vehicle and those of `offboard`, which has its system id."""

    def __init__(self, vehicle: Address | None, dialect: Dialect | None) -> None:
        self._vehicle, self._dialect = vehicle, dialect
        self._samples = {name: Samples(dtype) for name, dtype in _DTYPES.items()}
        self._ticks = _Ticks([_TIME, *((name, "f4") for name in FIELDS)])
        self._truth = _Truth([_TIME, ("position_ned_m", "3f4")])
        self._asked_ns, self._answered_ns = array("q"), array("q")  # of TIMESYNC; ts1, and ts1, tc1
        self._texts, self._our_texts = Texts("vehicle"), Texts("offboard")
        self._modes = Texts("vehicle")
        self._mode = ""
        self._event_records: list[tuple[float, bytes]] = []
        self._counts: Counter[str] = Counter()
        self._unix_us = (0, 0)
        self._anchor_ms = math.nan
        self._clocks: tuple[int, ...] = TELEMETRY + _SUBSTITUTES
        self.now_ms = math.nan  # stamp of the newest telemetry
        self.damage_ms = math.nan  # of the newest one before the first damage

    def add(self, entry: LoggedMessage) -> None:
        self._counts[entry.name] += 1
        self._unix_us = (self._unix_us[0] or entry.unix_us, entry.unix_us)
        ours = entry.component_id in OUR_COMPONENTS
        if ours and self._vehicle and entry.system_id != self._vehicle.system_id:
            return
        if not ours and (entry.system_id, entry.component_id) != self._vehicle:
            return
        name, payload = entry.name, entry.frame.payload
        if name in (_OURS if ours else _THEIRS):
            kind, wire = (_OURS if ours else _THEIRS)[name]
            self._samples[kind].add(wire, payload, self.now_ms, entry.unix_us / 1e6)
        elif name == "TIMESYNC":
            answered_ns, asked_ns = struct.unpack("<qq", payload[:16].ljust(16, b"\0"))
            if ours and not answered_ns:
                self._asked_ns.append(asked_ns)
            elif not ours and answered_ns:
                self._answered_ns.extend((asked_ns, answered_ns))
        elif name == "STATUSTEXT":
            (self._our_texts if ours else self._texts).add_chunk(entry, self.now_ms)
        elif ours:
            self._add_ours(name, entry)
        else:
            self._add_theirs(name, entry)
        if name == "HEARTBEAT" and self._dialect and not ours:
            mode = self._dialect.mode_name(int.from_bytes(payload[:4], "little"))
            if mode != self._mode:
                self._modes.add(mode, self.now_ms)
                self._mode = mode
        if entry.frame.message_id in self._clocks and not ours:
            if entry.frame.message_id in TELEMETRY:
                self._clocks = TELEMETRY
            self.now_ms = float(int.from_bytes(payload[:4], "little"))
            if math.isnan(self._anchor_ms):
                self._anchor_ms = self.now_ms

    def _add_ours(self, name: str, entry: LoggedMessage) -> None:
        payload = entry.frame.payload
        if name == _TICK.name and payload[10:20].rstrip(b"\0") in _ARRAYS:
            identified = int.from_bytes(payload[8:10], "little") == IDENTIFIED_ID
            samples = self._samples["identified"] if identified else self._ticks
            wire = _IDENTIFIED if identified else _TICK
            samples.add(wire, payload, self.now_ms, entry.unix_us / 1e6)
        elif record_type(entry) == event_record.PAYLOAD_TYPE:
            self._event_records.append((self.now_ms, entry.tunnelled))

    def _add_theirs(self, name: str, entry: LoggedMessage) -> None:
        if name in _SCALES and self._truth.origin:
            payload = entry.frame.payload
            wire = _SIM if name == _SIM.name else _HIL if any(payload[:8]) else _HIL_UNSTAMPED
            self._truth.add(wire, payload, self.now_ms, entry.unix_us / 1e6)
        elif name == "COMMAND_ACK":
            command, result = entry.message.command, entry.message.result
            if result not in (0, 5):  # MAV_RESULT_ACCEPTED, MAV_RESULT_IN_PROGRESS
                self._texts.add(f"command {command} refused, result {result}", self.now_ms)
        elif name in ("GPS_GLOBAL_ORIGIN", "HOME_POSITION"):
            at = entry.message
            place = Geodetic(at.latitude / 1e7, at.longitude / 1e7, at.altitude / 1e3)
            if name == "HOME_POSITION":
                place = origin_of(place, (at.x, at.y, at.z))
            self._truth.move(place)

    def history(self, damage: str) -> History:
        """All that was added."""
        anchor_ms = self._anchor_ms
        rows = {name: samples.rows(anchor_ms) for name, samples in self._samples.items()}
        constants = [_TIME, *((name, "2f4") for name in RECORDED)]
        rows["identified"] = rows["identified"].view(constants)
        armed = rows["heartbeat"]["armed"].astype(np.int64) & _ARMED
        rows["heartbeat"]["armed"] = armed > 0
        for column, unknown in (("voltage_mv", 0xFFFF), ("remaining", -1)):
            battery = rows["battery"][column]
            battery[battery == unknown] = math.nan
        events = ours(self._event_records, self._our_texts, anchor_ms)
        return History(
            **rows,
            truth=self._truth.rows(anchor_ms),
            records=self._ticks.rows(anchor_ms),
            link_delay=self._link_delay(),
            phases=tuple(event for event in events if event.phase),
            announcements=tuple(event for event in events if not event.phase),
            modes=self._modes.events(anchor_ms),
            vehicle_messages=self._texts.events(anchor_ms),
            vehicle=self._vehicle,
            dialect=self._dialect,
            messages=self._counts,
            wall_s=(self._unix_us[1] - self._unix_us[0]) / 1e6,
            damage=damage,
            damage_s=float(continuous_s(self.damage_ms, anchor_ms)),
        )

    def _link_delay(self) -> Rows:
        """From the vehicle's answers to our TIMESYNC requests."""
        answers = np.array(self._answered_ns, np.int64).reshape(-1, 2)
        asked, answered = answers[np.isin(answers[:, 0], np.array(self._asked_ns))].T
        rows = np.empty(len(asked), [_TIME, ("delay_s", "f8")])
        rows["time_s"], rows["delay_s"] = 1e-9 * asked, 1e-9 * (answered - asked)
        return rows


def _vehicle(log: Tlog) -> tuple[Address | None, Dialect | None]:
    """The vehicle that the manifest names, else the first autopilot that was heard."""
    known = {dialect.mav_autopilot: dialect for dialect in DIALECTS.values()}
    first: tuple[Address | None, Dialect | None] = (None, None)
    for entry in log:
        kind = entry.frame.message_id
        if kind == HEARTBEAT and first[0] is None:
            identity = decode_identity(entry.frame.payload)
            if is_vehicle(identity):
                heard = Address(entry.system_id, entry.component_id)
                first = heard, known.get(identity.autopilot)
        elif record_type(entry) == inputs.VEHICLE_TYPE:
            flown = inputs.vehicle_of(entry.tunnelled)
            if flown and flown.system_id == entry.system_id:
                found = Address(flown.system_id, flown.component_id)
                return found, DIALECTS.get(flown.autopilot)
    return first
