"""MCAP with Foxglove's protobuf schemas, for Foxglove, Lichtblick, Rerun and PlotJuggler.

Poses, paths and velocity are in the frame `map` (ENU, metres); the body frame is `base_link` (FLU).
Each series is also a channel `/table/NAME` of JSON messages with the columns of `series.py`, NED.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from offboard.analysis.columns import Rows
from offboard.analysis.history import History
from offboard.documents.errors import UserError, install
from offboard.export.series import (
    COLUMNS,
    PHASE,
    Array,
    events_of,
    samples,
    series_of,
)
from offboard.link.log import new_file
from offboard.model.frames import enu, flu_in_enu

MAP, BODY = "map", "base_link"  # frames: east, north, up; and forward, left, up
LINE_M = 0.02  # thickness of a path
COLOURS = {"flown": (0.12, 0.47, 0.71, 1.0), "reference": (1.0, 0.5, 0.05, 1.0)}  # RGBA
Stamped = tuple[int, str, Any]  # time in ns, topic, protobuf message or dict
Stamps = Callable[[Array], list[int]]  # converts vehicle times in s to stamps of the file in ns


def write_mcap(flown: History, path: Path) -> None:
    """Write an MCAP file. Raises UserError."""
    writers = _library("mcap.writer")
    register = _library("mcap_protobuf.schema").register_schema
    telemetry = [rows[0] for rows in (flown.position, flown.attitude) if len(rows)]
    begun_s, begun_unix_s = min((float(row["time_s"]), float(row["unix_s"])) for row in telemetry)

    def stamps(time_s: Array) -> list[int]:
        unix_s = time_s - begun_s + begun_unix_s
        return [max(0, round(stamp * 1e6)) * 1000 for stamp in unix_s.tolist()]

    messages = sorted(_messages(flown, stamps), key=lambda each: each[0])
    with new_file(path) as file:
        writer = writers.Writer(file)
        writer.start()
        channels: dict[str, int] = {}
        for stamp_ns, topic, message in messages:
            if topic not in channels:
                channels[topic] = _channel(writer, register, topic, message)
            data = (
                json.dumps(message).encode()
                if isinstance(message, dict)
                else message.SerializeToString()
            )
            writer.add_message(channels[topic], stamp_ns, data, stamp_ns)
        writer.finish()


def _messages(flown: History, stamps: Stamps) -> Iterator[Stamped]:
    found = series_of(flown)
    for name, rows in found.items():
        yield from _rows(name, rows, stamps)
    if "position" in found:
        yield from _motion(found["position"], found.get("attitude", flown.attitude[:0]), stamps)
    for name, topic in (("position", "flown"), ("reference", "reference")):
        if name in found:
            yield from _path(found[name], topic, stamps)
    log = _message("Log")
    for event in events_of(flown):
        (stamp_ns,) = stamps(np.array([event.time_s]))
        entry = log(level=log.INFO, message=event.what, name=event.who)
        entry.timestamp.FromNanoseconds(stamp_ns)
        yield stamp_ns, "/log", entry


def _channel(writer: Any, register: Any, topic: str, message: Any) -> int:
    if not isinstance(message, dict):
        schema, encoding = register(writer, type(message)), "protobuf"
    else:
        name = topic.rpartition("/")[2]
        numbers = {
            column: {"type": "string" if column == PHASE else "number"} for column in COLUMNS[name]
        }
        described = {
            "type": "object",
            "properties": {"vehicle_time_s": {"type": "number"}} | numbers,
        }
        data = json.dumps(described).encode()
        schema = writer.register_schema(name=f"offboard.{name}", encoding="jsonschema", data=data)
        encoding = "json"
    channel: int = writer.register_channel(topic=topic, message_encoding=encoding, schema_id=schema)
    return channel


# ------------------------------------------------------------------ messages


def _rows(name: str, rows: Rows, stamps: Stamps) -> Iterator[Stamped]:
    for stamp_ns, (time_s, _, known) in zip(
        stamps(rows["time_s"]), samples(name, rows), strict=True
    ):
        yield stamp_ns, f"/table/{name}", {"vehicle_time_s": time_s, **known}


def _motion(position: Rows, attitude: Rows, stamps: Stamps) -> Iterator[Stamped]:
    """Yield the velocity at each position, and the pose with the newest attitude."""
    vector, pose_in_frame = _message("Vector3"), _message("PoseInFrame")
    transform = _message("FrameTransform")
    newest = np.searchsorted(attitude["time_s"], position["time_s"], side="right") - 1
    quaternions = flu_in_enu(attitude["quaternion"]).tolist()
    columns = (position[name] for name in ("position_ned_m", "velocity_ned_mps"))
    places, velocities = (enu(column).tolist() for column in columns)
    for stamp_ns, place, velocity, index in zip(
        stamps(position["time_s"]), places, velocities, newest.tolist(), strict=True
    ):
        yield stamp_ns, "/velocity", vector(**dict(zip("xyz", velocity, strict=True)))
        if index < 0:
            continue
        pose = pose_in_frame(frame_id=MAP)
        frame = transform(parent_frame_id=MAP, child_frame_id=BODY)
        for timestamp, vector_of, rotation in (
            (pose.timestamp, pose.pose.position, pose.pose.orientation),
            (frame.timestamp, frame.translation, frame.rotation),
        ):
            timestamp.FromNanoseconds(stamp_ns)
            vector_of.x, vector_of.y, vector_of.z = place
            rotation.w, rotation.x, rotation.y, rotation.z = quaternions[index]
        yield stamp_ns, "/pose", pose
        yield stamp_ns, "/tf", frame


def _path(rows: Rows, topic: str, stamps: Stamps) -> Iterator[Stamped]:
    """Yield the whole path as one line, stamped with its begin."""
    (first_ns,) = stamps(rows["time_s"][:1])
    update = _message("SceneUpdate")()
    entity = update.entities.add(id=topic, frame_id=MAP)
    entity.timestamp.FromNanoseconds(first_ns)
    line = entity.lines.add(thickness=LINE_M)
    line.type = line.LINE_STRIP
    line.pose.orientation.w = 1.0
    line.color.r, line.color.g, line.color.b, line.color.a = COLOURS[topic]
    for x, y, z in enu(rows["position_ned_m"]).tolist():
        if math.isfinite(x + y + z):
            line.points.add(x=x, y=y, z=z)
    yield first_ns, f"/path/{topic}", update


def _message(name: str) -> Any:
    """Return a message class of Foxglove's schemas."""
    module = _library(f"foxglove_schemas_protobuf.{name}_pb2")
    return getattr(module, name)


def _library(name: str) -> Any:
    """Import a library of the extra `export`. Raises UserError with the line that installs it."""
    try:
        return import_module(name)
    except ImportError:
        needed = name.partition(".")[0]
        raise UserError(f"--to mcap needs {needed}: {install('export')}") from None
