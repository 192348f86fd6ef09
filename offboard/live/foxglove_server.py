"""The flight for Foxglove and Lichtblick: `python -m offboard.live.foxglove_server HOST PORT`.

Snapshots as JSON lines on stdin become messages of a Foxglove WebSocket server: poses and paths of
vehicle and reference in the frame "map" (east, north, up; m), all values of the snapshot, and the
texts. Topics and frames are those of `offboard export --to mcap`, so that one layout shows both.
Needs foxglove-sdk, the extra `foxglove` of this package.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections import deque
from typing import Any

from offboard.analysis.scene import BODY, COLOURS, LINE_M, MAP
from offboard.documents.arguments import join_address
from offboard.documents.extras import install
from offboard.link import clock
from offboard.live.values import json_schema
from offboard.model.frames import Array, enu, flu_in_enu, quaternion_from_euler

BACKLOG = 100  # messages that a client may be late; then it loses the oldest
PATH_POINTS = 3000  # the last five minutes
PATH_EVERY = 10  # snapshots, so that a late client has the paths after a second
LAST_S = 0.3  # for the last messages: the server drops what it has not sent when it stops
_NICENESS = 5


class Publisher:
    """Logs snapshots to the channels of the SDK, each with the computer's Unix time."""

    def __init__(self) -> None:
        import foxglove
        from foxglove import channels

        self._snapshot = foxglove.Channel("/snapshot", schema=json_schema())
        self._vehicle = channels.PoseInFrameChannel("/pose")
        self._reference = channels.PoseInFrameChannel("/reference")
        self._frames = channels.FrameTransformChannel("/tf")
        self._texts = channels.LogChannel("/log")
        self._paths = {name: channels.SceneUpdateChannel(f"/path/{name}") for name in COLOURS}
        self._points: dict[str, deque[Array]] = {
            name: deque(maxlen=PATH_POINTS) for name in COLOURS
        }
        self._published = 0
        self._told: list[str] = []

    def publish(self, snapshot: dict[str, Any]) -> None:
        """One snapshot, as `values.as_dict` makes it."""
        from foxglove.messages import FrameTransform, Log, LogLevel

        now_ns, stamp = _now()
        self._snapshot.log(snapshot, log_time=now_ns)
        position, attitude = snapshot["position_ned_m"], snapshot["attitude"]
        if position and attitude:
            at, turn = _vector(enu(position)), _quaternion(flu_in_enu(attitude))
            self._vehicle.log(_pose(stamp, at, turn), log_time=now_ns)
            transform = FrameTransform(
                timestamp=stamp, parent_frame_id=MAP, child_frame_id=BODY, translation=at,
                rotation=turn,
            )  # fmt: skip
            self._frames.log(transform, log_time=now_ns)
            self._points["flown"].append(enu(position))
        if snapshot["reference_ned_m"]:
            at = enu(snapshot["reference_ned_m"])
            course = flu_in_enu(quaternion_from_euler(0.0, 0.0, snapshot["course_rad"]))
            self._reference.log(_pose(stamp, _vector(at), _quaternion(course)), log_time=now_ns)
            self._points["reference"].append(at)
        texts = snapshot["texts"]
        for text in texts[_overlap(self._told, texts) :]:
            entry = Log(timestamp=stamp, level=LogLevel.Info, name="offboard", message=text)
            self._texts.log(entry, log_time=now_ns)
        self._told = texts
        self._published += 1
        if self._published % PATH_EVERY == 0:
            self.publish_paths()

    def publish_paths(self) -> None:
        """Both paths so far, each as one line that replaces the one before."""
        from foxglove.messages import Color, LinePrimitive, Point3, SceneEntity, SceneUpdate

        now_ns, stamp = _now()
        for name, points in self._points.items():
            line = LinePrimitive(
                points=[Point3(x=x, y=y, z=z) for x, y, z in points],
                thickness=LINE_M,
                color=Color(**dict(zip("rgba", COLOURS[name], strict=True))),
            )
            entity = SceneEntity(timestamp=stamp, frame_id=MAP, id=name, lines=[line])
            self._paths[name].log(SceneUpdate(entities=[entity]), log_time=now_ns)


def _now() -> tuple[int, Any]:
    """Unix time in ns, and as a timestamp of the SDK."""
    from foxglove.messages import Timestamp

    now_ns = clock.unix_us() * 1000
    return now_ns, Timestamp(now_ns // 10**9, now_ns % 10**9)


def _overlap(told: list[str], texts: list[str]) -> int:
    """How many of the first `texts` are the last of `told`."""
    longest = min(len(told), len(texts))
    return next((n for n in range(longest, 0, -1) if told[-n:] == texts[:n]), 0)


def _vector(values: Array) -> Any:
    from foxglove.messages import Vector3

    return Vector3(x=values[0], y=values[1], z=values[2])


def _quaternion(values: Array) -> Any:
    from foxglove.messages import Quaternion

    return Quaternion(w=values[0], x=values[1], y=values[2], z=values[3])


def _pose(stamp: Any, at: Any, turn: Any) -> Any:
    from foxglove.messages import Pose, PoseInFrame

    return PoseInFrame(timestamp=stamp, frame_id=MAP, pose=Pose(position=at, orientation=turn))


def main(host: str, port: int) -> None:
    """Serve until stdin closes."""
    try:
        import foxglove
    except ImportError:
        _answer(error=f"foxglove-sdk is missing: {install('foxglove')}")
        return
    foxglove.set_log_level("ERROR")  # a client that is refused is no line on the terminal
    try:
        server = foxglove.start_server(
            name="offboard", host=host, port=port, message_backlog_size=BACKLOG
        )
    except (OSError, RuntimeError) as error:
        address = join_address(host, port)
        _answer(error=f"{address} cannot be listened on ({error}); choose another address")
        return
    publisher = Publisher()
    _answer(url=f"ws://{join_address(host, server.port)}")
    for text in sys.stdin:
        publisher.publish(json.loads(text))
    publisher.publish_paths()
    threading.Event().wait(LAST_S)
    server.stop()


def _answer(**answer: str) -> None:
    print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    os.nice(_NICENESS)  # the controller goes first
    main(sys.argv[1], int(sys.argv[2]))
