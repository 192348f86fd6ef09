"""ULog: PX4's log format, with PX4's topic names and fields, for its tools.

Written here: pyulog can only write back what it has read. The format is that of PX4's developer
guide, "ULog File Format". Stamps are microseconds of vehicle time.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from operator import itemgetter
from pathlib import Path

import numpy as np

from offboard.analysis.history import History, Rows
from offboard.export.series import Array, events_of, series_of, values_of
from offboard.flight.record import FIELDS
from offboard.link.log import new_file
from offboard.model.frames import heading_from_quaternion

_MAGIC = b"ULog\x01\x12\x35\x01"
_FLAG_BITS, _FORMAT, _INFO, _SUBSCRIBE, _DATA, _TEXT = b"BFIADL"
_INFO_LEVEL = ord("6")
DECISION = "offboard_decision"


def _attitude_setpoint(setpoint: Rows) -> Array:
    """Thrust is along the body's -z axis, as PX4 has it."""
    attitude, thrust = setpoint["quaternion"], setpoint["thrust"]
    yaw = heading_from_quaternion(attitude)
    nothing = np.zeros_like(thrust)
    return np.column_stack((yaw, attitude, nothing, nothing, -thrust))


# series of the flight, its topic, names of its fields and how many values each, and the values
_NED = (("x", 1), ("y", 1), ("z", 1))
_TOPICS: tuple[tuple[str, str, tuple[tuple[str, int], ...], Callable[[Rows], Array]], ...] = (
    ("position", "vehicle_local_position", (*_NED, ("vx", 1), ("vy", 1), ("vz", 1)), values_of),
    ("truth", "vehicle_local_position_groundtruth", _NED, values_of),
    ("attitude", "vehicle_attitude", (("q", 4),), itemgetter("quaternion")),
    ("attitude", "vehicle_angular_velocity", (("xyz", 3),), itemgetter("rates_radps")),
    ("reference", "trajectory_setpoint",
     (("position", 3), ("velocity", 3), ("acceleration", 3), ("yaw", 1)), values_of),
    ("setpoint", "vehicle_attitude_setpoint",
     (("yaw_body", 1), ("q_d", 4), ("thrust_body", 3)), _attitude_setpoint),
    ("decision", DECISION, tuple((name, 1) for name in FIELDS), values_of),
    ("heartbeat", "actuator_armed", (("armed", 1),), itemgetter("armed")),
)  # fmt: skip
_BYTES = {"actuator_armed"}  # topics of bytes; the others are of float32
_AUTOPILOTS = {"px4": "PX4", "ardupilot": "ArduPilot"}  # as PX4's tools name them


def write_ulog(flown: History, path: Path) -> None:
    """Write a ULog file. Raises UserError."""
    found = series_of(flown)
    topics = [topic for topic in _TOPICS if topic[0] in found]
    entries: list[tuple[int, bytes]] = []
    for number, (name, topic, _, values) in enumerate(topics):
        rows = values(found[name]).astype(np.uint8 if topic in _BYTES else np.float32)
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
            file.write(_message(_FORMAT, _format(topic, fields).encode()))
        for number, (_, topic, *_) in enumerate(topics):
            file.write(_message(_SUBSCRIBE, struct.pack("<BH", 0, number) + topic.encode()))
        file.writelines(entry for _, entry in entries)


def _format(topic: str, fields: tuple[tuple[str, int], ...]) -> str:
    kind = "uint8_t" if topic in _BYTES else "float"
    rest = "".join(f"{kind}{f'[{n}]' if n > 1 else ''} {name};" for name, n in fields)
    return f"{topic}:uint64_t timestamp;{rest}"


def _message(kind: int, data: bytes) -> bytes:
    return struct.pack("<HB", len(data), kind) + data
