"""One flight as arrays and events, from its .tlog alone.

Times are vehicle time in seconds, positions NED in metres relative to the estimator's origin.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.sender import Sender, VehicleClock, streams_of
from offboard.analysis.tlog import LoggedMessage, Tlog, name_of
from offboard.flight import manifest
from offboard.flight.online_identification import RECORD_ID as IDENTIFIED_ID
from offboard.flight.online_identification import RECORD_NAME as IDENTIFIED_NAME
from offboard.flight.record import (
    COMPONENT_ID,
    RECORD_COMPONENT_ID,
    RECORD_ID,
    RECORD_NAME,
    TickRecord,
)
from offboard.mavlink.decode import decode_text_chunk
from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.session import DIALECTS
from offboard.mavlink.texts import TextAssembler
from offboard.model.geodesy import Geodetic, origin_of, position_ned_m

Array = NDArray[np.float64]
IDENTIFIED_SIZE = 20
OUR_COMPONENTS = (COMPONENT_ID, RECORD_COMPONENT_ID)
POSITION_FIELDS = "x y z vx vy vz"
ATTITUDE_FIELDS = "q1 q2 q3 q4 rollspeed pitchspeed yawspeed"
REFERENCE_FIELDS = "x y z vx vy vz afx afy afz yaw"
OUR_PREFIX = "offboard: "  # of the texts that announce a phase
_NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID: ground stations and companions


@dataclass(frozen=True, slots=True)
class Event:
    """A phase, a mode or a text: vehicle time (NaN before telemetry), sender, and what."""

    time_s: float
    who: str
    what: str


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

    `phases` are our own; the vehicle's are `modes` and `vehicle_messages` (STATUSTEXT, refused
    commands).
    """

    position: Array
    attitude: Array
    truth: Array
    reference: Array
    setpoint: Array
    record_time_s: Array
    records: tuple[TickRecord, ...]
    identified: Array
    link_delay: Array
    phases: tuple[Event, ...]
    modes: tuple[Event, ...]
    vehicle_messages: tuple[Event, ...]
    messages: Counter[str]
    wall_s: float


def gather(log: Tlog) -> History:
    """Sort a log's messages into a History. A log without a vehicle gives empty arrays."""
    streams = streams_of(log)
    vehicle_id, dialect = _vehicle(log.messages)
    ours = Sender(streams, lambda system, component: component in OUR_COMPONENTS)
    theirs = Sender(
        streams,
        lambda system, component: system == vehicle_id and component not in OUR_COMPONENTS,
    )
    clock = VehicleClock(theirs)
    arrays = [entry.message for _, entry in ours.of("DEBUG_FLOAT_ARRAY")]
    records = [
        (message.time_usec / 1e6, TickRecord.from_data(message.data))
        for message in arrays
        if _is(message, RECORD_ID, RECORD_NAME)
    ]
    identified = [
        (message.time_usec / 1e6, *message.data[:IDENTIFIED_SIZE])
        for message in arrays
        if _is(message, IDENTIFIED_ID, IDENTIFIED_NAME)
    ]
    stamps = [entry.unix_us for entry in log.messages]
    counts: Counter[str] = Counter()
    for (_, _, kind), stream in streams.items():
        counts[name_of(kind)] += len(stream)
    return History(
        position=theirs.table("LOCAL_POSITION_NED", POSITION_FIELDS),
        attitude=theirs.table("ATTITUDE_QUATERNION", ATTITUDE_FIELDS),
        truth=_truth(theirs, clock),
        reference=ours.table("POSITION_TARGET_LOCAL_NED", REFERENCE_FIELDS),
        setpoint=_setpoints(ours),
        record_time_s=np.array([time_s for time_s, _ in records]),
        records=tuple(record for _, record in records),
        identified=np.array(identified, dtype=np.float64).reshape(-1, 1 + IDENTIFIED_SIZE),
        link_delay=_link_delay(ours, theirs),
        phases=_events(clock, "offboard", _phases(ours)),
        modes=_events(clock, "vehicle", _modes(theirs, dialect)),
        vehicle_messages=_events(clock, "vehicle", _texts(theirs) + _refusals(theirs)),
        messages=counts,
        wall_s=(stamps[-1] - stamps[0]) / 1e6 if stamps else 0.0,
    )


def configuration(log: Tlog) -> str | None:
    """The configuration of the flight as YAML (see `flight.configuration.flown`), None without."""
    return manifest.join(
        bytes(entry.message.payload[: entry.message.payload_length])
        for entry in log.messages
        if entry.name == "TUNNEL"
        and entry.component_id in OUR_COMPONENTS
        and entry.message.payload_type == manifest.PAYLOAD_TYPE
    )


def _setpoints(ours: Sender) -> Array:
    """Attitude and position setpoints in the order in which they were sent."""
    kinds = ("SET_ATTITUDE_TARGET", "SET_POSITION_TARGET_LOCAL_NED")
    attitude, position = (ours.table(kind, "") for kind in kinds)
    aims = ours.columns(kinds[0], "q thrust")
    stamps = np.array([entry.unix_us / 1e6 for kind in kinds for _, entry in ours.of(kind)])
    rows = np.full((len(stamps), 7), math.nan)
    rows[:, 0] = np.concatenate((attitude[:, 0], position[:, 0]))
    rows[:, 1] = stamps
    rows[: len(aims), 2:] = aims
    return rows[np.argsort(np.concatenate([ours.places(kind) for kind in kinds]))]


def _link_delay(ours: Sender, theirs: Sender) -> Array:
    """From the vehicle's answers to our TIMESYNC requests."""
    requests, answers = (sender.columns("TIMESYNC", "ts1 tc1") for sender in (ours, theirs))
    sent = requests[requests[:, 1] == 0.0, 0]
    answered = answers[(answers[:, 1] != 0.0) & np.isin(answers[:, 0], sent)]
    return np.column_stack((answered[:, 0], answered[:, 1] - answered[:, 0])) * 1e-9


def _truth(theirs: Sender, clock: VehicleClock) -> Array:
    """True positions of a simulated vehicle, from the first origin of the local frame on."""
    homes = [(place, _origin_of_home(entry.message)) for place, entry in theirs.of("HOME_POSITION")]
    given = [
        (place, _origin_given(entry.message)) for place, entry in theirs.of("GPS_GLOBAL_ORIGIN")
    ]
    hil = theirs.columns("HIL_STATE_QUATERNION", "time_usec lat lon alt") / (1e6, 1e7, 1e7, 1e3)
    state = theirs.columns("SIM_STATE", "lat_int lon_int alt") / (1e7, 1e7, 1.0)
    rows = np.vstack((hil, np.insert(state, 0, 0.0, axis=1)))
    places = np.concatenate([theirs.places("HIL_STATE_QUATERNION"), theirs.places("SIM_STATE")])
    rows[:, 0] = np.where(rows[:, 0] > 0.0, rows[:, 0], clock.at(places))
    origins = sorted(homes + given)
    newest = np.searchsorted([place for place, _ in origins], places)
    known = np.flatnonzero(newest)
    known = known[np.argsort(places[known])]
    positions = [
        position_ned_m(Geodetic(*rows[row, 1:].tolist()), origins[newest[row] - 1][1])
        for row in known
    ]
    return np.column_stack((rows[known, 0], np.reshape(positions, (-1, 3))))


def _events(clock: VehicleClock, who: str, texts: Iterable[tuple[int, str]]) -> tuple[Event, ...]:
    """Events from (place in the log, text), in their order."""
    ordered = sorted(texts)
    times = clock.at(np.array([place for place, _ in ordered], dtype=np.intp))
    return tuple(
        Event(float(time_s), who, what) for time_s, (_, what) in zip(times, ordered, strict=True)
    )


def _phases(ours: Sender) -> list[tuple[int, str]]:
    return [
        (place, text.removeprefix(OUR_PREFIX))
        for place, text in _texts(ours)
        if text.startswith(OUR_PREFIX)
    ]


def _texts(sender: Sender) -> list[tuple[int, str]]:
    """All STATUSTEXT, joined from their chunks, each at the place of its last one."""
    assembler, texts = TextAssembler(), []
    for place, entry in sender.of("STATUSTEXT"):
        whole = assembler.add(decode_text_chunk(entry.frame.payload), entry.unix_us / 1e6)
        texts += [(place, text.text) for text in whole]
    return texts


def _modes(theirs: Sender, dialect: Dialect | None) -> list[tuple[int, str]]:
    modes: list[tuple[int, str]] = []
    if dialect is None:
        return modes
    for place, entry in theirs.of("HEARTBEAT"):
        mode = dialect.mode_name(entry.message.custom_mode)
        if entry.component_id == 1 and (not modes or modes[-1][1] != mode):
            modes.append((place, mode))
    return modes


def _refusals(theirs: Sender) -> list[tuple[int, str]]:
    acks = [(place, entry.message) for place, entry in theirs.of("COMMAND_ACK")]
    return [
        (place, f"command {ack.command} refused, result {ack.result}")
        for place, ack in acks
        if ack.result not in (0, 5)  # MAV_RESULT_ACCEPTED, MAV_RESULT_IN_PROGRESS
    ]


def _vehicle(messages: Iterable[LoggedMessage]) -> tuple[int | None, Dialect | None]:
    for entry in messages:
        if entry.name == "HEARTBEAT" and entry.message.autopilot != _NO_AUTOPILOT:
            known = {dialect.mav_autopilot: dialect for dialect in DIALECTS.values()}
            return entry.system_id, known.get(entry.message.autopilot)
    return None, None


def _origin_given(message: Any) -> Geodetic:
    return Geodetic(message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3)


def _origin_of_home(message: Any) -> Geodetic:
    """The origin of the local frame: HOME_POSITION gives one point in both frames."""
    place = message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3
    return origin_of(Geodetic(*place), (message.x, message.y, message.z))


def _is(message: Any, array_id: int, name: str) -> bool:
    return (message.array_id, message.name.rstrip("\0")) == (array_id, name)
