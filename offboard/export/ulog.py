"""ULog: PX4's log format, with PX4's topic names and fields, for its tools.

Written here: pyulog can only write back what it has read. The format is that of PX4's developer
guide, "ULog File Format". Stamps are microseconds of vehicle time.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from offboard.export.new_file import new_file
from offboard.export.series import Array, Flight, Series
from offboard.model.frames import course_from_quaternion

_MAGIC = b"ULog\x01\x12\x35\x01"
_FLAG_BITS, _FORMAT, _INFO, _SUBSCRIBE, _DATA, _TEXT = b"BFIADL"
_INFO_LEVEL = ord("6")
_TYPES = {"f": "float", "B": "uint8_t", "Q": "uint64_t"}
DECISION = "offboard_decision"


@dataclass(frozen=True, slots=True)
class _Topic:
    """`fields` are names and counts of float32 values, or of bytes where `code` is "B"."""

    name: str
    fields: tuple[tuple[str, int], ...]
    series: Series
    values: Callable[[Series], Array]
    code: str = "f"

    @property
    def format(self) -> str:
        kind = _TYPES[self.code]
        rest = "".join(f"{kind}{f'[{n}]' if n > 1 else ''} {name};" for name, n in self.fields)
        return f"{self.name}:uint64_t timestamp;{rest}"

    def payloads(self) -> list[bytes]:
        width = sum(count for _, count in self.fields)
        packer = struct.Struct(f"<Q{width}{self.code}")
        rows = self.values(self.series).tolist()
        stamps = np.round(self.series.time_s * 1e6).astype(np.int64).tolist()
        convert = int if self.code == "B" else float
        return [
            packer.pack(max(stamp, 0), *map(convert, row))
            for stamp, row in zip(stamps, rows, strict=True)
        ]


def write_ulog(flight: Flight, path: Path) -> None:
    """Write a ULog file. Raises ExportError."""
    topics = _topics(flight)
    entries: list[tuple[int, bytes]] = []
    for number, topic in enumerate(topics):
        for payload in topic.payloads():
            stamp = int.from_bytes(payload[:8], "little")
            entries.append((stamp, _message(_DATA, struct.pack("<H", number) + payload)))
    for event in flight.events:
        stamp = max(0, round(event.time_s * 1e6))
        text = f"{event.who}: {event.what}".encode()
        entries.append((stamp, _message(_TEXT, struct.pack("<BQ", _INFO_LEVEL, stamp) + text)))
    entries.sort(key=lambda entry: entry[0])
    start = entries[0][0] if entries else 0
    with new_file(path) as file:
        file.write(_MAGIC + struct.pack("<Q", start) + _message(_FLAG_BITS, bytes(40)))
        for key, value in (("sys_name", flight.autopilot), ("ver_sw", "offboard export")):
            file.write(_info(key, value))
        for topic in topics:
            file.write(_message(_FORMAT, topic.format.encode()))
        for number, topic in enumerate(topics):
            file.write(_message(_SUBSCRIBE, struct.pack("<BH", 0, number) + topic.name.encode()))
        for _, entry in entries:
            file.write(entry)


def _topics(flight: Flight) -> list[_Topic]:
    """The topics for which the flight has samples."""
    ned, rates = ("x", "y", "z", "vx", "vy", "vz"), slice(4, 7)
    rows: dict[str, list[tuple[str, tuple[tuple[str, int], ...], Callable[[Series], Array]]]] = {
        "position": [
            ("vehicle_local_position", tuple((name, 1) for name in ned), lambda s: s.values)
        ],
        "truth": [
            (
                "vehicle_local_position_groundtruth",
                (("x", 1), ("y", 1), ("z", 1)),
                lambda s: s.values,
            )
        ],
        "attitude": [
            ("vehicle_attitude", (("q", 4),), lambda s: s.values[:, :4]),
            ("vehicle_angular_velocity", (("xyz", 3),), lambda s: s.values[:, rates]),
        ],
        "reference": [
            (
                "trajectory_setpoint",
                (("position", 3), ("velocity", 3), ("acceleration", 3), ("yaw", 1)),
                lambda s: s.values,
            )
        ],
        "setpoint": [
            (
                "vehicle_attitude_setpoint",
                (("yaw_body", 1), ("q_d", 4), ("thrust_body", 3)),
                _attitude_setpoint,
            )
        ],
        "decision": [
            (
                DECISION,
                tuple((name, 1) for name in _short(flight.series.get("decision"))),
                lambda s: s.values,
            )
        ],
    }
    topics = [
        _Topic(name, fields, flight.series[kind], values)
        for kind, topics in rows.items()
        if kind in flight.series
        for name, fields, values in topics
    ]
    if "heartbeat" in flight.series:
        heartbeat = flight.series["heartbeat"]
        topics.append(_Topic("actuator_armed", (("armed", 1),), heartbeat, _armed, "B"))
    return topics


def _short(decision: Series | None) -> tuple[str, ...]:
    names = decision.columns if decision else ()
    return tuple(name.removeprefix("decision_") for name in names)


def _armed(heartbeat: Series) -> Array:
    return heartbeat.values[:, :1]


def _attitude_setpoint(setpoint: Series) -> Array:
    """Thrust is along the body's -z axis, as PX4 has it."""
    attitude, thrust = setpoint.values[:, :4], setpoint.values[:, 4]
    yaw = course_from_quaternion(attitude)
    nothing = np.zeros_like(thrust)
    return np.column_stack((yaw, attitude, nothing, nothing, -thrust))


def _info(key: str, text: str) -> bytes:
    value = text.encode()
    name = f"char[{len(value)}] {key}".encode()
    return _message(_INFO, bytes([len(name)]) + name + value)


def _message(kind: int, data: bytes) -> bytes:
    return struct.pack("<HB", len(data), kind) + data
