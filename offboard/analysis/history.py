"""One flight as arrays, from its .tlog alone: vehicle, reference, decisions, setpoints, story.

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

from offboard.analysis.tlog import LoggedMessage, Tlog
from offboard.flight import manifest
from offboard.flight.record import (
    COMPONENT_ID,
    RECORD_COMPONENT_ID,
    RECORD_ID,
    RECORD_NAME,
    TickRecord,
)
from offboard.mavlink.dialect import Dialect
from offboard.mavlink.session import DIALECTS

Array = NDArray[np.float64]
OUR_COMPONENTS = (COMPONENT_ID, RECORD_COMPONENT_ID)
EARTH_RADIUS_M = 6371000.0  # of PX4 map projection
ATTITUDE_FIELDS = "q1 q2 q3 q4 rollspeed pitchspeed yawspeed"
REFERENCE_FIELDS = "x y z vx vy vz afx afy afz yaw"
Geodetic = tuple[float, float, float]  # latitude and longitude in degrees, altitude in m
_NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID: ground stations and companions


@dataclass(frozen=True, slots=True)
class Happening:
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
    """

    position: Array
    attitude: Array
    truth: Array
    reference: Array
    setpoint: Array
    record_time_s: Array
    records: tuple[TickRecord, ...]
    phases: tuple[Happening, ...]
    modes: tuple[Happening, ...]
    said: tuple[Happening, ...]
    messages: Counter[str]
    wall_s: float


def gather(log: Tlog) -> History:
    """Sort a log's messages into a History. A log without a vehicle gives empty arrays."""
    vehicle_id, dialect = _vehicle(log.messages)
    rows: dict[str, list[tuple[float, ...]]] = {
        name: [] for name in ("position", "attitude", "truth", "reference", "setpoint")
    }
    records: list[tuple[float, TickRecord]] = []
    phases: list[Happening] = []
    modes: list[Happening] = []
    said: list[Happening] = []
    origin: Geodetic | None = None
    now_s = math.nan
    for entry in log.messages:
        message = entry.message
        ours = entry.component_id in OUR_COMPONENTS
        if not ours and entry.system_id != vehicle_id:
            continue
        match entry.name:
            case "LOCAL_POSITION_NED":
                now_s = message.time_boot_ms / 1e3
                rows["position"].append(
                    (now_s, message.x, message.y, message.z, message.vx, message.vy, message.vz)
                )
            case "ATTITUDE_QUATERNION":
                now_s = message.time_boot_ms / 1e3
                rows["attitude"].append((now_s, *_values(message, ATTITUDE_FIELDS)))
            case "HOME_POSITION":
                origin = _origin_of_home(message)
            case "GPS_GLOBAL_ORIGIN":
                origin = message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3
            case "HIL_STATE_QUATERNION" if origin:
                stamp_s = message.time_usec / 1e6 or now_s
                place = message.lat / 1e7, message.lon / 1e7, message.alt / 1e3
                rows["truth"].append((stamp_s, *_local(*place, origin)))
            case "SIM_STATE" if origin:
                place = message.lat_int / 1e7, message.lon_int / 1e7, message.alt
                rows["truth"].append((now_s, *_local(*place, origin)))
            case "POSITION_TARGET_LOCAL_NED" if ours:
                stamp_s = message.time_boot_ms / 1e3
                rows["reference"].append((stamp_s, *_values(message, REFERENCE_FIELDS)))
            case "SET_ATTITUDE_TARGET" if ours:
                stamp_s = message.time_boot_ms / 1e3
                rows["setpoint"].append((stamp_s, entry.unix_us / 1e6, *message.q, message.thrust))
            case "SET_POSITION_TARGET_LOCAL_NED" if ours:
                stamp_s = message.time_boot_ms / 1e3
                rows["setpoint"].append((stamp_s, entry.unix_us / 1e6, *(math.nan,) * 5))
            case "DEBUG_FLOAT_ARRAY" if ours and _is_record(message):
                records.append((message.time_usec / 1e6, TickRecord.from_data(message.data)))
            case "STATUSTEXT":
                text = message.text.rstrip("\t")
                if ours and text.startswith("offboard: "):
                    phases.append(Happening(now_s, "offboard", text.removeprefix("offboard: ")))
                elif not ours:
                    said.append(Happening(now_s, "vehicle", text))
            case "COMMAND_ACK" if message.result not in (0, 5):
                refusal = f"command {message.command} refused, result {message.result}"
                said.append(Happening(now_s, "vehicle", refusal))
            case "HEARTBEAT" if dialect and entry.component_id == 1:
                mode = dialect.mode_name(message.custom_mode)
                if not modes or modes[-1].what != mode:
                    modes.append(Happening(now_s, "vehicle", mode))
    stamps = [entry.unix_us for entry in log.messages]
    return History(
        position=_table(rows["position"], 7),
        attitude=_table(rows["attitude"], 8),
        truth=_table(rows["truth"], 4),
        reference=_table(rows["reference"], 11),
        setpoint=_table(rows["setpoint"], 7),
        record_time_s=np.array([time_s for time_s, _ in records]),
        records=tuple(record for _, record in records),
        phases=tuple(phases),
        modes=tuple(modes),
        said=tuple(said),
        messages=Counter(entry.name for entry in log.messages),
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


def _vehicle(messages: Iterable[LoggedMessage]) -> tuple[int | None, Dialect | None]:
    for entry in messages:
        if entry.name == "HEARTBEAT" and entry.message.autopilot != _NO_AUTOPILOT:
            known = {dialect.mav_autopilot: dialect for dialect in DIALECTS.values()}
            return entry.system_id, known.get(entry.message.autopilot)
    return None, None


def _origin_of_home(message: Any) -> Geodetic:
    """Where the local frame's origin is: HOME_POSITION gives one point in both frames."""
    latitude, longitude = message.latitude / 1e7, message.longitude / 1e7
    metres = math.radians(1.0) * EARTH_RADIUS_M
    return (
        latitude - message.x / metres,
        longitude - message.y / (metres * math.cos(math.radians(latitude))),
        message.altitude / 1e3 + message.z,
    )


def _local(
    latitude: float, longitude: float, altitude_m: float, origin: Geodetic
) -> tuple[float, ...]:
    """North, east, down from the origin; the plane is exact to a millimetre within 100 m."""
    metres = math.radians(1.0) * EARTH_RADIUS_M
    return (
        (latitude - origin[0]) * metres,
        (longitude - origin[1]) * metres * math.cos(math.radians(origin[0])),
        origin[2] - altitude_m,
    )


def _values(message: Any, names: str) -> tuple[float, ...]:
    return tuple(getattr(message, name) for name in names.split())


def _is_record(message: Any) -> bool:
    return (message.array_id, message.name.rstrip("\0")) == (RECORD_ID, RECORD_NAME)


def _table(rows: list[tuple[float, ...]], columns: int) -> Array:
    return np.array(rows, dtype=np.float64).reshape(-1, columns)
