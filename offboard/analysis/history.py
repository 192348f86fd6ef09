"""One flight as arrays, from its .tlog alone: vehicle, reference, decisions, setpoints, story.

Times are vehicle time in seconds, positions NED in metres relative to the estimator's origin.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.tlog import LoggedMessage, Tlog, columns, name_of
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
OUR_WORDS = "offboard: "  # before every phase that we announce
# (system, component, message id) -> (place in the log, message), in order
Streams = dict[tuple[int, int, int], list[tuple[int, LoggedMessage]]]
_NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID: ground stations and companions


@dataclass(frozen=True, slots=True)
class Event:
    """Something said or done: vehicle time (NaN before telemetry), who, and the words."""

    time_s: float
    who: str
    what: str


@dataclass(frozen=True, slots=True)
class History:
    """Rows (N, columns) in the order of arrival. Columns:

    position: t, north, east, down, v_north, v_east, v_down (LOCAL_POSITION_NED)
    attitude: t, w, x, y, z, p, q, r (ATTITUDE_QUATERNION)
    truth: t, north, east, down (HIL_STATE_QUATERNION or SIM_STATE; empty without)
    reference: t, position 3, velocity 3, acceleration 3, course (POSITION_TARGET_LOCAL_NED)
    setpoint: t, wall time s, w, x, y, z, thrust (SET_ATTITUDE_TARGET); NaN from the third on where
        the autopilot's own position loop was given one
    identified: t, then what `flight.takeover.record_of` says
    link_delay: t of the telemetry a question was stamped with, s until it arrived (TIMESYNC)
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
    said: tuple[Event, ...]
    messages: Counter[str]
    wall_s: float


def gather(log: Tlog) -> History:
    """Sort a log's messages into a History. A log without a vehicle gives empty arrays."""
    streams = _streams(log)
    vehicle_id, dialect = _vehicle(log.messages)
    ours = _Party(streams, lambda system, component: component in OUR_COMPONENTS)
    theirs = _Party(
        streams,
        lambda system, component: system == vehicle_id and component not in OUR_COMPONENTS,
    )
    clock = _Clock(theirs)
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
        phases=_phases(ours, clock),
        modes=_modes(theirs, clock, dialect),
        said=_said(theirs, clock),
        messages=counts,
        wall_s=(stamps[-1] - stamps[0]) / 1e6 if stamps else 0.0,
    )


def configuration(log: Tlog) -> str | None:
    """What the flight was flown with, as `config.flown` reads it; None where the log lacks it."""
    return manifest.join(
        bytes(entry.message.payload[: entry.message.payload_length])
        for entry in log.messages
        if entry.name == "TUNNEL"
        and entry.component_id in OUR_COMPONENTS
        and entry.message.payload_type == manifest.PAYLOAD_TYPE
    )


def _streams(log: Tlog) -> Streams:
    streams: Streams = {}
    for place, entry in enumerate(log.messages):
        frame = entry.frame
        key = frame.system_id, frame.component_id, frame.message_id
        streams.setdefault(key, []).append((place, entry))
    return streams


class _Party:
    """What one side of the link sent: messages by name, each with its place in the log."""

    def __init__(self, streams: Streams, sent: Callable[[int, int], bool]) -> None:
        self._kinds: dict[str, list[tuple[int, LoggedMessage]]] = {}
        for (system, component, kind), stream in streams.items():
            if sent(system, component):
                self._kinds.setdefault(name_of(kind), []).extend(stream)
        for stream in self._kinds.values():
            stream.sort(key=itemgetter(0))

    def of(self, name: str) -> list[tuple[int, LoggedMessage]]:
        """(place, message) of all messages of that name."""
        return self._kinds.get(name, [])

    def places(self, name: str) -> NDArray[np.intp]:
        return np.array([place for place, _ in self.of(name)], dtype=np.intp)

    def columns(self, name: str, fields: str) -> Array:
        """(N, columns): the fields of all messages of that name."""
        return columns(name, [entry for _, entry in self.of(name)], fields)

    def table(self, name: str, fields: str) -> Array:
        """The same after their vehicle time in seconds."""
        rows = self.columns(name, f"time_boot_ms {fields}")
        rows[:, 0] /= 1e3
        return rows


class _Clock:
    """Vehicle time at a place in the log: the newest that telemetry had told by then."""

    def __init__(self, theirs: _Party) -> None:
        names = ("LOCAL_POSITION_NED", "ATTITUDE_QUATERNION")
        places = np.concatenate([theirs.places(name) for name in names])
        times = np.concatenate([theirs.table(name, "")[:, 0] for name in names])
        order = np.argsort(places)
        self._places, self._times = places[order], np.append(math.nan, times[order])

    def at(self, places: NDArray[np.intp]) -> Array:
        """(N,) seconds, NaN before any telemetry."""
        times: Array = self._times[np.searchsorted(self._places, places)]
        return times

    def story(self, who: str, told: Iterable[tuple[int, str]]) -> tuple[Event, ...]:
        """What was told at places in the log, in their order."""
        ordered = sorted(told)
        times = self.at(np.array([place for place, _ in ordered], dtype=np.intp))
        return tuple(
            Event(float(time_s), who, what)
            for time_s, (_, what) in zip(times, ordered, strict=True)
        )


def _setpoints(ours: _Party) -> Array:
    """Of both kinds, in the order in which they were sent."""
    kinds = ("SET_ATTITUDE_TARGET", "SET_POSITION_TARGET_LOCAL_NED")
    attitude, position = (ours.table(kind, "") for kind in kinds)
    aims = ours.columns(kinds[0], "q thrust")
    stamps = np.array([entry.unix_us / 1e6 for kind in kinds for _, entry in ours.of(kind)])
    rows = np.full((len(stamps), 7), math.nan)
    rows[:, 0] = np.concatenate((attitude[:, 0], position[:, 0]))
    rows[:, 1] = stamps
    rows[: len(aims), 2:] = aims
    return rows[np.argsort(np.concatenate([ours.places(kind) for kind in kinds]))]


def _link_delay(ours: _Party, theirs: _Party) -> Array:
    """By the answers to our own questions."""
    questions, answers = (party.columns("TIMESYNC", "ts1 tc1") for party in (ours, theirs))
    asked = questions[questions[:, 1] == 0.0, 0]
    answered = answers[(answers[:, 1] != 0.0) & np.isin(answers[:, 0], asked)]
    return np.column_stack((answered[:, 0], answered[:, 1] - answered[:, 0])) * 1e-9


def _truth(theirs: _Party, clock: _Clock) -> Array:
    """Where the simulated vehicle is, once its log has said where the local frame's origin is."""
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
    told = [
        (
            rows[row, 0],
            *position_ned_m(Geodetic(*rows[row, 1:].tolist()), origins[newest[row] - 1][1]),
        )
        for row in known
    ]
    return np.array(told, dtype=np.float64).reshape(-1, 4)


def _phases(ours: _Party, clock: _Clock) -> tuple[Event, ...]:
    told = [
        (place, text.removeprefix(OUR_WORDS))
        for place, text in _texts(ours)
        if text.startswith(OUR_WORDS)
    ]
    return clock.story("offboard", told)


def _texts(party: _Party) -> list[tuple[int, str]]:
    """All that was said, joined from its chunks, each at the place of its last one."""
    assembler, said = TextAssembler(), []
    for place, entry in party.of("STATUSTEXT"):
        whole = assembler.add(decode_text_chunk(entry.frame.payload), entry.unix_us / 1e6)
        said += [(place, text.text) for text in whole]
    return said


def _modes(theirs: _Party, clock: _Clock, dialect: Dialect | None) -> tuple[Event, ...]:
    told: list[tuple[int, str]] = []
    if dialect is None:
        return ()
    for place, entry in theirs.of("HEARTBEAT"):
        mode = dialect.mode_name(entry.message.custom_mode)
        if entry.component_id == 1 and (not told or told[-1][1] != mode):
            told.append((place, mode))
    return clock.story("vehicle", told)


def _said(theirs: _Party, clock: _Clock) -> tuple[Event, ...]:
    words = _texts(theirs)
    acks = [(place, entry.message) for place, entry in theirs.of("COMMAND_ACK")]
    refused = [
        (place, f"command {ack.command} refused, result {ack.result}")
        for place, ack in acks
        if ack.result not in (0, 5)
    ]
    return clock.story("vehicle", words + refused)


def _vehicle(messages: Iterable[LoggedMessage]) -> tuple[int | None, Dialect | None]:
    for entry in messages:
        if entry.name == "HEARTBEAT" and entry.message.autopilot != _NO_AUTOPILOT:
            known = {dialect.mav_autopilot: dialect for dialect in DIALECTS.values()}
            return entry.system_id, known.get(entry.message.autopilot)
    return None, None


def _origin_given(message: Any) -> Geodetic:
    return Geodetic(message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3)


def _origin_of_home(message: Any) -> Geodetic:
    """Where the local frame's origin is: HOME_POSITION gives one point in both frames."""
    place = message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3
    return origin_of(Geodetic(*place), (message.x, message.y, message.z))


def _is(message: Any, array_id: int, name: str) -> bool:
    return (message.array_id, message.name.rstrip("\0")) == (array_id, name)
