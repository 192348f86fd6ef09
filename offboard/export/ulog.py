"""ULog: PX4's log format, with PX4's topic names and fields, for PX4's tools.

This module writes the format itself, because pyulog can only write files that it has read. Source:
PX4's developer guide, "ULog File Format". Stamps are microseconds of vehicle time.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from operator import itemgetter
from pathlib import Path

import numpy as np

from offboard.analysis.columns import Rows
from offboard.analysis.history import History
from offboard.export.series import Array, events_of, series_of, values_of
from offboard.flight.record import FIELDS
from offboard.link.log import new_file
from offboard.model.frames import heading_from_quaternion

_MAGIC = b"ULog\x01\x12\x35\x01"
_FLAG_BITS, _FORMAT, _INFO, _SUBSCRIBE, _DATA, _TEXT = b"BFIADL"
_INFO_LEVEL = ord("6")
DECISION = "offboard_decision"


def _attitude_setpoint(setpoint: Rows) -> Array:
    """Return the fields of vehicle_attitude_setpoint. Thrust is along the body's -z axis."""
    attitude, thrust = setpoint["quaternion"], setpoint["thrust"]
    yaw = heading_from_quaternion(attitude)
    nothing = np.zeros_like(thrust)
    return np.column_stack((yaw, attitude, nothing, nothing, -thrust))


# series of the flight, PX4's topic, format of its fields, function that returns their values
_TOPICS: tuple[tuple[str, str, str, Callable[[Rows], Array]], ...] = (
    ("position", "vehicle_local_position", "float x;float y;float z;float vx;float vy;float vz;",
     values_of),
    ("truth", "vehicle_local_position_groundtruth", "float x;float y;float z;", values_of),
    ("attitude", "vehicle_attitude", "float[4] q;", itemgetter("quaternion")),
    ("attitude", "vehicle_angular_velocity", "float[3] xyz;", itemgetter("rates_radps")),
    ("reference", "trajectory_setpoint",
     "float[3] position;float[3] velocity;float[3] acceleration;float yaw;", values_of),
    ("setpoint", "vehicle_attitude_setpoint",
     "float yaw_body;float[4] q_d;float[3] thrust_body;", _attitude_setpoint),
    ("decision", DECISION, "".join(f"float {name};" for name in FIELDS), values_of),
    ("heartbeat", "actuator_armed", "uint8_t armed;", itemgetter("armed")),
)  # fmt: skip
_AUTOPILOTS = {"px4": "PX4", "ardupilot": "ArduPilot"}  # names that PX4's tools use


def write_ulog(flown: History, path: Path) -> None:
    """Write a ULog file. Raises UserError."""
    found = series_of(flown)
    topics = [topic for topic in _TOPICS if topic[0] in found]
    entries: list[tuple[int, bytes]] = []
    for number, (name, _, fields, values) in enumerate(topics):
        kind = np.float32 if fields.startswith("float") else np.uint8
        rows = values(found[name]).astype(kind)
        stamps = np.maximum(np.round(found[name]["time_s"] * 1e6), 0.0).astype(np.int64).tolist()
        for stamp, row in zip(stamps, rows, strict=True):
            data = struct.pack("<HQ", number, stamp) + row.tobytes()
            entries.append((stamp, _message(_DATA, data)))
    for event in events_of(flown):
        stamp = max(0, round(event.time_s * 1e6))
        text = f"{event.who}: {event.what}".encode()
        entries.append((stamp, _message(_TEXT, struct.pack("<BQ", _INFO_LEVEL, stamp) + text)))
    entries.sort(key=lambda entry: entry[0])
    start = entries[0][0] if entries else 0
    autopilot = _AUTOPILOTS[flown.dialect.name] if flown.dialect else "unknown"
    with new_file(path) as file:
        file.write(_MAGIC + struct.pack("<Q", start) + _message(_FLAG_BITS, bytes(40)))
        for key, value in (("sys_name", autopilot), ("ver_sw", "offboard export")):
            info = f"char[{len(value)}] {key}".encode()
            file.write(_message(_INFO, bytes([len(info)]) + info + value.encode()))
        for _, topic, fields, _ in topics:
            file.write(_message(_FORMAT, f"{topic}:uint64_t timestamp;{fields}".encode()))
        for number, (_, topic, *_) in enumerate(topics):
            file.write(_message(_SUBSCRIBE, struct.pack("<BH", 0, number) + topic.encode()))
        file.writelines(entry for _, entry in entries)


def _message(kind: int, data: bytes) -> bytes:
    return struct.pack("<HB", len(data), kind) + data
