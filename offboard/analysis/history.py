"""One flight as arrays and events, from its .tlog alone: whole, or in stretches of bounded memory.

Times are vehicle time in seconds, continued where `time_boot_ms` begins again at zero. Positions
are NED in metres relative to the estimator's origin.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.events import Event, announcements, modes, phases, vehicle_messages
from offboard.analysis.sender import Stream, continuous_s
from offboard.analysis.tlog import LoggedMessage, Tlog, TlogError
from offboard.analysis.truth import true_positions
from offboard.flight import manifest
from offboard.flight.record import (
    COMPONENT_ID,
    IDENTIFIED_NAME,
    LAYOUTS,
    RECORD_COMPONENT_ID,
    RECORD_NAME,
    records_of,
)
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
STRETCH = 100_000  # messages, about five minutes of all that PX4 sends
LATE_S = 3.0  # telemetry that is older when it arrives is not scored
OVERLAP_S = 1.0  # longer than the interval of signals that are interpolated, if none is lost
_TUNNEL = 385  # message id
_ARRAYS = {RECORD_NAME, IDENTIFIED_NAME}
_ARMED = 0x80  # MAV_MODE_FLAG_SAFETY_ARMED
TELEMETRY = (31, 32)  # ATTITUDE_QUATERNION, LOCAL_POSITION_NED
_SUBSTITUTES = (30, 33)  # ATTITUDE, GLOBAL_POSITION_INT: the clock of logs without these
# kinds of messages of which every stretch has its own, and kinds that are kept from the beginning
_OUR_SAMPLES = (
    "SET_ATTITUDE_TARGET", "SET_POSITION_TARGET_LOCAL_NED", "POSITION_TARGET_LOCAL_NED",
    "DEBUG_FLOAT_ARRAY",
)  # fmt: skip
_SAMPLES = ("ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "SIM_STATE", "HIL_STATE_QUATERNION")
_OUR_NEWS = ("TIMESYNC", "STATUSTEXT")
_NEWS = (
    "HEARTBEAT", "GPS_GLOBAL_ORIGIN", "COMMAND_ACK", "TIMESYNC", "HOME_POSITION",
    "EXTENDED_SYS_STATE", "STATUSTEXT",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class History:
    """Rows (N, columns) in the order of arrival, and events. Columns:

    position: t, north, east, down, v_north, v_east, v_down (LOCAL_POSITION_NED)
    attitude: t, w, x, y, z, p, q, r (ATTITUDE_QUATERNION)
    truth: t, north, east, down (HIL_STATE_QUATERNION or SIM_STATE; empty without)
    reference: t, position 3, velocity 3, acceleration 3, course (POSITION_TARGET_LOCAL_NED)
    setpoint: t, wall time s, w, x, y, z, thrust (SET_ATTITUDE_TARGET); NaN from the third on for a
        setpoint of the autopilot's own position loop (SET_POSITION_TARGET_LOCAL_NED)
    identified: t, then value and sd of each constant as in `identification.adoption.record_of`
    link_delay: t of the telemetry that a TIMESYNC request followed, its delay in s
    heartbeat: t, armed (1 or 0), MAV_STATE
    landed: t, MAV_LANDED_STATE (EXTENDED_SYS_STATE)

    `records` (N,) are structured, with the fields of `flight.record.TickRecord`. `phases` and
    `announcements` are our own, `modes` and `vehicle_messages` (STATUSTEXT, refused commands) the
    vehicle's. `vehicle` is the one that was flown, as the log's manifest says; in an older log the
    first autopilot that was heard. Only its messages, and ours, are used. It and `dialect` are None
    without one, `dialect` also for one that is not known. `damage` says what could not be
    read, `damage_s` is the time of the telemetry before the first damage, NaN without.
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
    *_, (history, _) = stretches(log, messages=2**62)
    return history


def stretches(log: Tlog, messages: int = STRETCH) -> Iterator[tuple[History, float]]:
    """The flight in stretches of so many messages, each with the time up to which it is complete.

    The rows of a stretch begin OVERLAP_S before the time up to which the previous stretch was
    complete, and with the last one before that; after a reboot without this overlap. Events,
    `identified`, `link_delay`, `heartbeat` and `landed` are all since the beginning. The last
    stretch is complete up to infinity.
    """
    collector = _Collector(*_vehicle(log))
    complete_s = -math.inf
    for count, entry in enumerate(log, 1):
        if log.damaged and math.isnan(collector.damage_ms):
            collector.damage_ms = collector.now_ms
        collector.add(entry)
        if count % messages == 0:
            until_s = float(collector.time_s(collector.now_ms)) - LATE_S
            if until_s < complete_s:  # the vehicle was rebooted
                collector.drop(complete_s)
            yield collector.history(), until_s
            collector.drop(until_s - OVERLAP_S)
            complete_s = until_s
    yield collector.history(log.damage), math.inf


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
        self._ours = {name: Stream(name) for name in (*_OUR_SAMPLES, *_OUR_NEWS)}
        self._theirs = {name: Stream(name) for name in (*_SAMPLES, *_NEWS)}
        self._counts: Counter[str] = Counter()
        self._unix_us = (0, 0)
        self._place = 0
        self._anchor_ms = math.nan
        self._clocks: tuple[int, ...] = TELEMETRY + _SUBSTITUTES
        self.now_ms = math.nan  # stamp of the newest telemetry
        self.damage_ms = math.nan  # of the newest one before the first damage
        self._rows: dict[str, Array] = {}  # of the present stretch
        self._identified: list[Array] = []

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

    def drop(self, until_s: float) -> None:
        """Forget the samples before the last one that is not newer than `until_s`."""
        for name, rows in self._rows.items():
            newest = np.maximum.accumulate(rows[:, 0])
            first = np.searchsorted(newest, until_s, side="right") - 1
            self._rows[name] = rows[max(first, 0) :].copy()

    def history(self, damage: str = "") -> History:
        """The present stretch."""
        arrays = self._ours["DEBUG_FLOAT_ARRAY"].columns("time_usec array_id data")
        arrays[:, 0] = self.time_s(arrays[:, 0] / 1e3)
        of_ticks = np.isin(arrays[:, 1], list(LAYOUTS))
        samples = {
            "position": self._table(self._theirs["LOCAL_POSITION_NED"], POSITION_FIELDS),
            "attitude": self._table(self._theirs["ATTITUDE_QUATERNION"], ATTITUDE_FIELDS),
            "truth": true_positions(self._theirs, self.time_s),
            "reference": self._table(self._ours["POSITION_TARGET_LOCAL_NED"], REFERENCE_FIELDS),
            "setpoint": self._setpoints(),
            "ticks": arrays[of_ticks],
        }
        self._rows = {
            name: np.vstack((self._rows[name], rows)) if name in self._rows else rows
            for name, rows in samples.items()
        }
        self._identified.extend(np.delete(arrays[~of_ticks], 1, axis=1)[:, : 1 + IDENTIFIED_SIZE])
        for name in _OUR_SAMPLES:
            self._ours[name].clear()
        for name in _SAMPLES:
            self._theirs[name].clear()
        return self._history(damage)

    def _history(self, damage: str) -> History:
        tables = dict(self._rows)
        ticks = tables.pop("ticks")
        heartbeat = self._news("HEARTBEAT", "base_mode system_status")
        heartbeat[:, 1] = (heartbeat[:, 1].astype(np.int64) & _ARMED) > 0
        return History(
            **tables,
            record_time_s=ticks[:, 0],
            records=records_of(ticks[:, 2:], ticks[:, 1]),
            identified=np.reshape(self._identified, (-1, 1 + IDENTIFIED_SIZE)),
            link_delay=self._link_delay(),
            heartbeat=heartbeat,
            landed=self._news("EXTENDED_SYS_STATE", "landed_state"),
            phases=phases(self._ours["STATUSTEXT"], self.time_s),
            announcements=announcements(self._ours["STATUSTEXT"], self.time_s),
            modes=modes(self._theirs["HEARTBEAT"], self._dialect, self.time_s),
            vehicle_messages=vehicle_messages(
                self._theirs["STATUSTEXT"], self._theirs["COMMAND_ACK"], self.time_s
            ),
            vehicle=self._vehicle,
            dialect=self._dialect,
            messages=self._counts.copy(),
            wall_s=(self._unix_us[1] - self._unix_us[0]) / 1e6,
            damage=damage,
            damage_s=float(self.time_s(self.damage_ms)),
        )

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
