"""One flight as columns and events, read once from its .tlog.

Times are vehicle time in seconds, continued where `time_boot_ms` begins again at zero. Positions
are NED in metres relative to the estimator's origin.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.events import Event, modes, ours, vehicle_messages
from offboard.analysis.sender import Stream, continuous_s
from offboard.analysis.tlog import LoggedMessage, Tlog, TlogError
from offboard.analysis.truth import true_positions
from offboard.flight import manifest
from offboard.flight.record import (
    COMPONENT_ID,
    IDENTIFIED_ID,
    IDENTIFIED_NAME,
    RECORD_COMPONENT_ID,
    RECORD_NAME,
    records_of,
)
from offboard.mavlink import event_record
from offboard.mavlink.decode import Address, decode_identity
from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.framing import HEARTBEAT
from offboard.mavlink.senders import DIALECTS, is_vehicle

Array = NDArray[np.float64]
IDENTIFIED_SIZE = 20
OUR_COMPONENTS = (COMPONENT_ID, RECORD_COMPONENT_ID)
POSITION_FIELDS = "x y z vx vy vz"
ATTITUDE_FIELDS = "q1 q2 q3 q4 rollspeed pitchspeed yawspeed"
REFERENCE_FIELDS = "x y z vx vy vz afx afy afz yaw"
_TUNNEL = 385  # message id
_ARRAYS = {RECORD_NAME, IDENTIFIED_NAME}
_ARMED = 0x80  # MAV_MODE_FLAG_SAFETY_ARMED
TELEMETRY = (31, 32)  # ATTITUDE_QUATERNION, LOCAL_POSITION_NED
_SUBSTITUTES = (30, 33)  # ATTITUDE, GLOBAL_POSITION_INT: the clock of logs without these
_OURS = (
    "SET_ATTITUDE_TARGET", "SET_POSITION_TARGET_LOCAL_NED", "POSITION_TARGET_LOCAL_NED",
    "DEBUG_FLOAT_ARRAY", "TIMESYNC", "STATUSTEXT", "TUNNEL",
)  # fmt: skip
_THEIRS = (
    "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "SIM_STATE", "HIL_STATE_QUATERNION", "HEARTBEAT",
    "GPS_GLOBAL_ORIGIN", "COMMAND_ACK", "TIMESYNC", "HOME_POSITION", "EXTENDED_SYS_STATE",
    "STATUSTEXT",
)  # fmt: skip
# frequent kinds whose own stamps are used: their place and time in the log are not kept
_STAMPED = {
    "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "POSITION_TARGET_LOCAL_NED", "DEBUG_FLOAT_ARRAY",
}  # fmt: skip
_BLOCK = 20_000  # records that are converted at once


@dataclass(frozen=True, slots=True)
class History:
    """Rows (N, columns) in the order of arrival, and events. Columns:

    position: t, north, east, down, v_north, v_east, v_down (LOCAL_POSITION_NED)
    attitude: t, w, x, y, z, p, q, r (ATTITUDE_QUATERNION)
    truth: t, north, east, down (HIL_STATE_QUATERNION or SIM_STATE; empty without)
    reference: t, position 3, velocity 3, acceleration 3, heading (POSITION_TARGET_LOCAL_NED)
    setpoint: t, wall time s, w, x, y, z, thrust (SET_ATTITUDE_TARGET); NaN from the third on for a
        setpoint of the autopilot's own position loop (SET_POSITION_TARGET_LOCAL_NED)
    identified: t, then value and sd of each constant as in `identification.vehicle_fit.log_record`
    link_delay: t of the telemetry that a TIMESYNC request followed, its delay in s
    heartbeat: t, armed (1 or 0), MAV_STATE
    landed: t, MAV_LANDED_STATE (EXTENDED_SYS_STATE)

    `records` (N,) are structured, with the fields of `flight.record.TickRecord`. `phases` and
    `announcements` are our own, by their records; `modes` and `vehicle_messages` (STATUSTEXT,
    refused commands) the vehicle's. `vehicle` is the one that was flown, as the log's manifest
    says; in an older log the first autopilot that was heard. Only its messages, and ours, are used.
    It and `dialect` are None without one, `dialect` also for one that is not known. `damage` says
    what could not be read, `damage_s` is the time of the telemetry before the first damage, NaN
    without.
    """

    position: Array
    attitude: Array
    truth: Array
    reference: Array
    setpoint: Array
    record_time_s: Array
    records: NDArray[np.void]
    identified: Array
    link_delay: Array
    heartbeat: Array
    landed: Array
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
    pieces = (
        entry.tunnelled
        for entry in log
        if entry.name == "TUNNEL"
        and entry.component_id in OUR_COMPONENTS
        and entry.message.payload_type == manifest.PAYLOAD_TYPE
    )
    try:
        return manifest.join(pieces)
    except ValueError as error:
        raise TlogError(f"{log.path}: {error}") from None


class _Collector:
    """Collects the messages of this vehicle and those of `offboard`, which has its system id."""

    def __init__(self, vehicle: Address | None, dialect: Dialect | None) -> None:
        self._vehicle = vehicle
        self._dialect = dialect
        self._ours = {name: Stream(name, placed=name not in _STAMPED) for name in _OURS}
        self._theirs = {name: Stream(name, placed=name not in _STAMPED) for name in _THEIRS}
        self._counts: Counter[str] = Counter()
        self._unix_us = (0, 0)
        self._place = 0
        self._anchor_ms = math.nan
        self._clocks: tuple[int, ...] = TELEMETRY + _SUBSTITUTES
        self.now_ms = math.nan  # stamp of the newest telemetry
        self.damage_ms = math.nan  # of the newest one before the first damage

    def add(self, entry: LoggedMessage) -> None:
        kind, name = entry.frame.message_id, entry.name
        self._counts[name] += 1
        self._unix_us = (self._unix_us[0] or entry.unix_us, entry.unix_us)
        self._place += 1
        ours = entry.component_id in OUR_COMPONENTS
        if ours:
            theirs = self._vehicle is not None and entry.system_id != self._vehicle.system_id
        else:
            theirs = (entry.system_id, entry.component_id) != self._vehicle
        if theirs:  # of another system or component
            return
        stream = (self._ours if ours else self._theirs).get(name)
        if stream is not None and _is_used(entry, ours):
            stream.add(entry, self._place, self.now_ms)
        if kind in self._clocks and not ours:
            if kind in TELEMETRY:
                self._clocks = TELEMETRY
            self.now_ms = float(int.from_bytes(entry.frame.payload[:4], "little"))
            if math.isnan(self._anchor_ms):
                self._anchor_ms = self.now_ms

    def history(self, damage: str) -> History:
        """All that was added. Frees what it was made of, so that a long log fits in memory."""
        record_time_s, records, identified = self._arrays(self._ours.pop("DEBUG_FLOAT_ARRAY"))
        heartbeat = self._news("HEARTBEAT", "base_mode system_status")
        heartbeat[:, 1] = (heartbeat[:, 1].astype(np.int64) & _ARMED) > 0
        events = ours(self._ours["TUNNEL"], self._ours["STATUSTEXT"], self.time_s)
        return History(
            attitude=self._table(self._theirs.pop("ATTITUDE_QUATERNION"), ATTITUDE_FIELDS),
            position=self._table(self._theirs.pop("LOCAL_POSITION_NED"), POSITION_FIELDS),
            truth=true_positions(self._theirs, self.time_s),
            reference=self._table(self._ours.pop("POSITION_TARGET_LOCAL_NED"), REFERENCE_FIELDS),
            setpoint=self._setpoints(),
            record_time_s=record_time_s,
            records=records,
            identified=identified,
            link_delay=self._link_delay(),
            heartbeat=heartbeat,
            landed=self._news("EXTENDED_SYS_STATE", "landed_state"),
            phases=tuple(event for event in events if event.phase),
            announcements=tuple(event for event in events if not event.phase),
            modes=modes(self._theirs["HEARTBEAT"], self._dialect, self.time_s),
            vehicle_messages=vehicle_messages(
                self._theirs["STATUSTEXT"], self._theirs["COMMAND_ACK"], self.time_s
            ),
            vehicle=self._vehicle,
            dialect=self._dialect,
            messages=self._counts,
            wall_s=(self._unix_us[1] - self._unix_us[0]) / 1e6,
            damage=damage,
            damage_s=float(self.time_s(self.damage_ms)),
        )

    def _arrays(self, stream: Stream) -> tuple[Array, NDArray[np.void], Array]:
        """Times and records of the ticks; and what was identified."""
        stamps = stream.columns("time_usec array_id")
        times, of_ticks = self.time_s(stamps[:, 0] / 1e3), stamps[:, 1] != IDENTIFIED_ID
        found: list[Array] = []
        records: list[NDArray[np.void]] = []
        for first in range(0, max(len(stream), 1), _BLOCK):
            block = slice(first, first + _BLOCK)
            data, ticks = stream.columns("data", block), of_ticks[block]
            records.append(records_of(data[ticks], stamps[block, 1][ticks]))
            found.append(np.column_stack((times[block][~ticks], data[~ticks, :IDENTIFIED_SIZE])))
        return times[of_ticks], np.concatenate(records), np.vstack(found)

    # ------------------------------------------------------------------ time

    def time_s(self, stamps_ms: Array | float) -> Array:
        return continuous_s(np.asarray(stamps_ms, dtype=np.float64), self._anchor_ms)

    def _table(self, stream: Stream, fields: str) -> Array:
        rows = stream.columns(f"time_boot_ms {fields}")
        rows[:, 0] = self.time_s(rows[:, 0])
        return rows

    def _news(self, name: str, fields: str) -> Array:
        """Fields of the vehicle's messages, with the time of the telemetry before as first."""
        stream = self._theirs[name]
        return np.column_stack((self.time_s(np.array(stream.now_ms)), stream.columns(fields)))

    # ------------------------------------------------------------------ samples

    def _setpoints(self) -> Array:
        """Attitude and position setpoints in the order in which they were sent."""
        attitude = self._ours["SET_ATTITUDE_TARGET"]
        position = self._ours["SET_POSITION_TARGET_LOCAL_NED"]
        rows = np.full((len(attitude) + len(position), 7), math.nan)
        stamps = (attitude.columns("time_boot_ms"), position.columns("time_boot_ms"))
        rows[:, 0] = self.time_s(np.concatenate(stamps)[:, 0])
        rows[:, 1] = np.concatenate((attitude.unix_us, position.unix_us)) / 1e6
        rows[: len(attitude), 2:] = attitude.columns("q thrust")
        return rows[np.argsort(np.concatenate((attitude.places, position.places)))]

    def _link_delay(self) -> Array:
        """From the vehicle's answers to our TIMESYNC requests."""
        requests, answers = (
            streams["TIMESYNC"].columns("ts1 tc1") for streams in (self._ours, self._theirs)
        )
        answered = answers[np.isin(answers[:, 0], requests[:, 0])]
        return np.column_stack((answered[:, 0], answered[:, 1] - answered[:, 0])) * 1e-9


def _is_used(entry: LoggedMessage, ours: bool) -> bool:
    """Whether a message of a kind that is collected is one of those that we need."""
    name, payload = entry.name, entry.frame.payload
    if name == "TIMESYNC":  # our requests, and replies of the vehicle: tc1 is 0 in a request
        return any(payload[:8]) != ours
    if name == "DEBUG_FLOAT_ARRAY":
        return payload[10:20].rstrip(b"\0").decode(errors="replace") in _ARRAYS
    if name == "TUNNEL":
        return int.from_bytes(payload[:2], "little") == event_record.PAYLOAD_TYPE
    return True


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
        elif kind == _TUNNEL and entry.component_id in OUR_COMPONENTS:
            is_ours = entry.message.payload_type == manifest.VEHICLE_TYPE
            flown = manifest.vehicle_of(entry.tunnelled) if is_ours else None
            if flown and flown.system_id == entry.system_id:
                found = Address(flown.system_id, flown.component_id)
                return found, DIALECTS.get(flown.autopilot)
    return first
