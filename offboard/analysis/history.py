"""One flight as columns and events, read once from its .tlog.

Times are vehicle time in seconds, which continues where `time_boot_ms` wraps to zero. Positions are
NED in metres relative to the estimator's origin.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from offboard.analysis import columns
from offboard.analysis.columns import OURS, THEIRS, Array, Rows, Samples
from offboard.analysis.tlog import OUR_COMPONENTS, LoggedMessage, Tlog
from offboard.documents.errors import UserError
from offboard.flight import record
from offboard.flight.phases import Phase
from offboard.mavlink import event_record
from offboard.mavlink.decode import ARMED, Address
from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.framing import HEARTBEAT
from offboard.mavlink.senders import DIALECTS, dialect_of, is_vehicle
from offboard.mavlink.texts import TextAssembler
from offboard.mavlink.vehicle_time import Age, VehicleTime
from offboard.model.geodesy import Geodetic, origin_of

TELEMETRY = (31, 32)  # ATTITUDE_QUATERNION, LOCAL_POSITION_NED
_SUBSTITUTES = (30, 33)  # ATTITUDE, GLOBAL_POSITION_INT: the clock of logs without TELEMETRY
_INSTEAD_OF = {
    "ATTITUDE": "ATTITUDE_QUATERNION",
    "GLOBAL_POSITION_INT": "LOCAL_POSITION_NED",
    "ATTITUDE_TARGET": "SET_ATTITUDE_TARGET",
}
PHASES: dict[int | None, str] = {phase.code: phase.value for phase in Phase}
_NO_ATTITUDE = struct.pack("<8f", *(math.nan,) * 8)  # follows the stamp of SET_ATTITUDE_TARGET


@dataclass(frozen=True, slots=True)
class Event:
    """A phase that begins, a change of mode or a text.

    `time_s` is vehicle time, NaN before the first telemetry; `unix_s` is the time of the log entry.
    `phase` is the phase that begins, empty for other events; `cause` is a word or two, or empty.
    """

    time_s: float
    who: str
    what: str
    phase: str = ""
    cause: str = ""
    unix_s: float = math.nan

    @property
    def stamp(self) -> str:
        """Vehicle time as text, empty before the first telemetry."""
        return "" if math.isnan(self.time_s) else f"{self.time_s:.2f}"

    @property
    def reason(self) -> str:
        """Why the phase begins."""
        return self.what.removeprefix(f"{self.phase}: ")


@dataclass(frozen=True, slots=True)
class History:
    """Structured arrays (N,) in the order of arrival, and events. Each array has the fields
    `time_s`, `unix_s` (time of the log entry: in `setpoint`, and in the others if `gather` is told
    to keep it), and:

    position: position_ned_m, velocity_ned_mps (LOCAL_POSITION_NED, or GLOBAL_POSITION_INT with
        positions relative to the first one)
    attitude: quaternion (w, x, y, z), rates_radps (ATTITUDE_QUATERNION, or ATTITUDE)
    truth: position_ned_m (HIL_STATE_QUATERNION or SIM_STATE; no rows if the log has neither)
    reference: position, velocity and acceleration, heading_rad (POSITION_TARGET_LOCAL_NED)
    setpoint: quaternion, thrust (SET_ATTITUDE_TARGET); both are NaN for a setpoint of the
        autopilot's own position loop (SET_POSITION_TARGET_LOCAL_NED)
    commanded: as `setpoint`; in a log without setpoints what the vehicle reports (ATTITUDE_TARGET)
    identified: value and sd of each constant of `flight.record.IDENTIFIED`
    link_delay: delay_s, at the stamp of the telemetry after which the TIMESYNC request was sent
    heartbeat: armed (1 or 0), system_status (MAV_STATE)
    battery: voltage_mv, remaining in percent; NaN where it is not known (SYS_STATUS)
    landed: state (MAV_LANDED_STATE of EXTENDED_SYS_STATE)
    records: the fields of `flight.record.TickRecord`

    `phases` and `announcements` are read from our event records, `modes` (HEARTBEAT) and
    `vehicle_messages` (STATUSTEXT, refused commands) from the vehicle's messages. `vehicle` is the
    one that our vehicle record names, or else the first autopilot in the log, or None; only its
    messages and ours are used. `dialect` is None also for an unknown autopilot. `substitutes` are
    the messages that took the place of missing ones, as in the log of a ground station. `unread`
    says what was not read, damaged entries last; `damaged_s` is the time of the newest telemetry
    before the first of them, or NaN.
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
    unread: str = ""
    damaged_s: float = math.nan

    def estimates(self, constant: str) -> tuple[Array, Array]:
        """Return the times (N,) at which a constant was identified, its values and sd (N, 2)."""
        known = self.identified[np.isfinite(self.identified[constant][:, 0])]
        return known["time_s"], known[constant].astype(np.float64)

    def events(self) -> list[Event]:
        """Return phases, announcements, modes and messages of the vehicle in the order of time;
        those before the first telemetry first, in the order of the log."""
        modes = (replace(event, what=f"mode {event.what}") for event in self.modes)
        every = (*self.phases, *self.announcements, *modes, *self.vehicle_messages)
        return sorted(every, key=lambda e: (np.nan_to_num(e.time_s, nan=-math.inf), e.unix_s))


def gather(log: Tlog, *, unix_times: bool = False) -> History:
    """Read a log into a History. A log without a vehicle gives empty arrays. `unix_times`: whether
    to keep the time of the log entry of every message, not only of setpoints."""
    vehicle, dialect, others = _vehicle(log)
    collector = _Collector(vehicle, dialect, unix_times=unix_times)
    for entry in log:
        if log.damaged and math.isnan(collector.damaged_s):
            collector.damaged_s = collector.now_s
        collector.add(entry)
    return collector.history("; ".join(filter(None, (others, log.unread))))


def configuration(log: Tlog) -> str | None:
    """Return the configuration of the flight as YAML (see `run.configuration.flown`), None if the
    log has none. Raises UserError."""
    pieces = (entry.tunnelled for entry in log if entry.record_type == record.CONFIGURATION_TYPE)
    try:
        return record.joined_configuration(pieces)
    except ValueError as error:
        raise UserError(f"{log.path}: {error}") from None


class _Collector:
    """Collects the messages of one vehicle, and those of `offboard`, which has its system id."""

    def __init__(
        self, vehicle: Address | None, dialect: Dialect | None, *, unix_times: bool
    ) -> None:
        self._vehicle, self._dialect = vehicle, dialect
        self._ours, self._theirs = (
            {
                kind: Samples(kind, each, unix_times=unix_times or kind == "SET_ATTITUDE_TARGET")
                for kind, each in kinds.items()
            }
            for kinds in (OURS, THEIRS)
        )
        self._origin: Geodetic | None = None  # of the local frame
        self._assembler = TextAssembler()
        self._texts: list[Event] = []  # STATUSTEXT and refused commands
        self._modes: list[Event] = []
        self._event_records: list[tuple[float, float, bytes]] = []
        self._counts: Counter[str] = Counter()
        self._unix_us = (0, 0)
        self._clocks: tuple[int, ...] = TELEMETRY + _SUBSTITUTES
        self._time = VehicleTime()
        self.now_s = math.nan  # vehicle time of the newest telemetry
        self.damaged_s = math.nan  # vehicle time of the newest telemetry before the first damage

    def add(self, entry: LoggedMessage) -> None:
        frame, vehicle = entry.frame, self._vehicle
        payload, unix_s = frame.payload, entry.unix_us / 1e6
        self._counts[entry.name] += 1
        self._unix_us = (self._unix_us[0] or entry.unix_us, entry.unix_us)
        if frame.component_id in OUR_COMPONENTS:
            if vehicle is None or frame.system_id == vehicle.system_id:
                self._add_ours(entry, payload, unix_s)
        elif (
            (frame.system_id, frame.component_id) == vehicle
            and not self._is_of_another(entry)
            and self._follow(frame.message_id, payload)
        ):
            self._add_theirs(entry, payload, unix_s)

    def _is_of_another(self, entry: LoggedMessage) -> bool:
        """Whether this is a HEARTBEAT of another program with the ids of the vehicle; the flight
        has ignored it, too."""
        if entry.frame.message_id != HEARTBEAT or not self._dialect:
            return False
        return dialect_of(entry.message) is not self._dialect

    def _keep(self, samples: Samples | None, payload: bytes, unix_s: float) -> None:
        """Add a message; one without a time stamp has the vehicle time of the telemetry before. So
        has a setpoint of another program, whose `time_boot_ms` is that of its own clock."""
        if samples:
            foreign = samples is self._ours["SET_ATTITUDE_TARGET"] and not self._event_records
            stamp_ms = None if foreign else samples.stamp_ms(payload)
            time_s = self.now_s if stamp_ms is None else self._continued_s(stamp_ms)
            samples.add(payload, time_s, unix_s)

    def _continued_s(self, stamp_ms: float) -> float:
        """Return the vehicle time of a stamp, which wraps to zero after 2^32 ms. A stamp that does
        not wrap (`time_usec`) gives the same time."""
        return (stamp_ms + 1e3 * self._time.wrapped_s(stamp_ms / 1e3)) / 1e3

    def _follow(self, kind: int, payload: bytes) -> bool:
        """Update the vehicle time, also after a reboot. Return False for telemetry with a stamp so
        far ahead that the flight has refused it, too."""
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
        kind = entry.name
        if kind == "SET_POSITION_TARGET_LOCAL_NED":
            kind, payload = "SET_ATTITUDE_TARGET", payload[:4] + _NO_ATTITUDE
        elif kind == columns.ARRAY:
            kind = f"{kind} {entry.message.array_id}"
        elif entry.record_type == event_record.EVENT_TYPE:
            self._event_records.append((self.now_s, unix_s, entry.tunnelled))
        self._keep(self._ours.get(kind), payload, unix_s)

    def _add_theirs(self, entry: LoggedMessage, payload: bytes, unix_s: float) -> None:
        kind = entry.name
        if kind == "STATUSTEXT":
            for text in self._assembler.add(payload, unix_s):
                self._say(self._texts, text.text, unix_s)
        elif kind == "COMMAND_ACK":
            command, result = entry.message.command, entry.message.result
            if result not in (0, 5):  # MAV_RESULT_ACCEPTED, MAV_RESULT_IN_PROGRESS
                self._say(self._texts, f"command {command} refused, result {result}", unix_s)
        elif kind in ("GPS_GLOBAL_ORIGIN", "HOME_POSITION"):
            self._add_origin(entry)
        elif kind == "HEARTBEAT" and self._dialect:
            mode = self._dialect.mode_name(int.from_bytes(payload[:4], "little"))
            if not self._modes or mode != self._modes[-1].what:
                self._say(self._modes, mode, unix_s)
        instead = _INSTEAD_OF.get(kind, "")
        usual = self._theirs.get(instead) or self._ours.get(instead)
        if not (usual and usual.data):  # a substitute beside the usual message would waste memory
            self._keep(self._theirs.get(kind), payload, unix_s)

    def _say(self, events: list[Event], what: str, unix_s: float) -> None:
        events.append(Event(self.now_s, "vehicle", what, unix_s=unix_s))

    def _forget_before_flight(self) -> None:
        """After a reboot, discard the messages before it if no setpoint was sent yet: they do not
        belong to the flight."""
        if not self._ours["SET_ATTITUDE_TARGET"].data:
            for samples in self._theirs.values():
                samples.data.clear()

    def _add_origin(self, entry: LoggedMessage) -> None:
        """Set the origin of the local frame. HOME_POSITION gives one point in global and in local
        coordinates. An origin that moves after the first decision is ignored: the positions before
        are relative to the old one."""
        at = entry.message
        place = Geodetic(at.latitude / 1e7, at.longitude / 1e7, at.altitude / 1e3)
        if entry.name == "GPS_GLOBAL_ORIGIN":
            if self._origin is None or not self._ours[columns.RECORDS].data:
                self._origin = place
        elif self._origin is None:  # GPS_GLOBAL_ORIGIN is better: ArduCopter sends x, y, z = 0
            self._origin = origin_of(place, (at.x, at.y, at.z))

    def history(self, unread: str) -> History:
        """Return all messages that were added."""
        theirs, ours = (
            {kind: samples.rows() for kind, samples in kinds.items()}
            for kinds in (self._theirs, self._ours)
        )
        heartbeat, setpoint = theirs["HEARTBEAT"], ours["SET_ATTITUDE_TARGET"]
        heartbeat["armed"] = heartbeat["armed"] & ARMED > 0
        position = columns.plausible(theirs["LOCAL_POSITION_NED"])
        attitude = columns.plausible(theirs["ATTITUDE_QUATERNION"])
        substitutes = []
        # The reference of `offboard` has the local origin, and GLOBAL_POSITION_INT another one
        if not len(position) and not len(ours["POSITION_TARGET_LOCAL_NED"]):
            position = columns.position_of_global(theirs["GLOBAL_POSITION_INT"])
            substitutes.append("GLOBAL_POSITION_INT")
        if not len(attitude):
            attitude = columns.attitude_of_angles(theirs["ATTITUDE"])
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
            truth=columns.truth(theirs, self._origin),
            reference=ours["POSITION_TARGET_LOCAL_NED"],
            setpoint=setpoint,
            commanded=setpoint if len(setpoint) else theirs["ATTITUDE_TARGET"],
            records=ours[columns.RECORDS],
            identified=ours[columns.IDENTIFIED],
            link_delay=columns.link_delay(ours["TIMESYNC"], theirs["TIMESYNC"]),
            heartbeat=heartbeat,
            battery=columns.battery(theirs["SYS_STATUS"]),
            landed=theirs["EXTENDED_SYS_STATE"],
            phases=tuple(event for event in events if event.phase),
            announcements=tuple(event for event in events if not event.phase),
            modes=tuple(self._modes),
            vehicle_messages=tuple(self._texts),
            vehicle=self._vehicle,
            dialect=self._dialect,
            messages=self._counts,
            wall_s=(self._unix_us[1] - self._unix_us[0]) / 1e6,
            substitutes=tuple(substitutes),
            unread=unread,
            damaged_s=self.damaged_s,
        )


def _vehicle(log: Tlog) -> tuple[Address | None, Dialect | None, str]:
    """Return the vehicle that our vehicle record names, or else the first autopilot in the log, and
    then a sentence about the others."""
    heard: dict[Address, Dialect | None] = {}
    for entry in log:
        if entry.frame.message_id == HEARTBEAT:
            if is_vehicle(entry.message):
                at = Address(entry.system_id, entry.component_id)
                heard.setdefault(at, dialect_of(entry.message))
        elif entry.record_type == record.VEHICLE_TYPE:
            flown = record.vehicle_of(entry.tunnelled)
            if flown and flown.system_id == entry.system_id:
                found = Address(flown.system_id, flown.component_id)
                return found, DIALECTS.get(flown.autopilot), ""
    if not heard:
        return None, None, ""
    first, *others = heard
    systems = ", ".join(str(each.system_id) for each in others)
    said = f"{log.path}: of several vehicles the first is used, not system {systems}"
    return first, heard[first], said if others else ""
