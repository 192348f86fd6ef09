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

from offboard.export.series import Array, Flight, Series
from offboard.flight.record import FIELDS
from offboard.link.log import new_file
from offboard.model.frames import heading_from_quaternion

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
    """Write a ULog file. Raises UserError."""
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
    topics: list[_Topic] = []

    def add(
        series: str,
        name: str,
        fields: tuple[tuple[str, int], ...],
        values: Callable[[Series], Array] = lambda each: each.values,
        code: str = "f",
    ) -> None:
        if series in flight.series:
            topics.append(_Topic(name, fields, flight.series[series], values, code))

    ned = tuple((name, 1) for name in ("x", "y", "z", "vx", "vy", "vz"))
    add("position", "vehicle_local_position", ned)
    add("truth", "vehicle_local_position_groundtruth", ned[:3])
    add("attitude", "vehicle_attitude", (("q", 4),), lambda each: each.values[:, :4])
    add("attitude", "vehicle_angular_velocity", (("xyz", 3),), lambda each: each.values[:, 4:7])
    motion = (("position", 3), ("velocity", 3), ("acceleration", 3), ("yaw", 1))
    add("reference", "trajectory_setpoint", motion)
    attitude = (("yaw_body", 1), ("q_d", 4), ("thrust_body", 3))
    add("setpoint", "vehicle_attitude_setpoint", attitude, _attitude_setpoint)
    add("decision", DECISION, tuple((name, 1) for name in FIELDS))
    add("heartbeat", "actuator_armed", (("armed", 1),), lambda each: each.values[:, :1], "B")
    return topics


def _attitude_setpoint(setpoint: Series) -> Array:
    """Thrust is along the body's -z axis, as PX4 has it."""
    attitude, thrust = setpoint.values[:, :4], setpoint.values[:, 4]
    yaw = heading_from_quaternion(attitude)
    nothing = np.zeros_like(thrust)
    return np.column_stack((yaw, attitude, nothing, nothing, -thrust))


def _info(key: str, text: str) -> bytes:
    value = text.encode()
    name = f"char[{len(value)}] {key}".encode()
    return _message(_INFO, bytes([len(name)]) + name + value)


def _message(kind: int, data: bytes) -> bytes:
    return struct.pack("<HB", len(data), kind) + data
