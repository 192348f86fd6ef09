"""The flight for Foxglove and Lichtblick: `python -m offboard.live.foxglove_server HOST PORT`.

Snapshots as JSON lines on stdin become messages of a Foxglove WebSocket server: poses of vehicle
and reference in the frame "local" (east, north, up; m), all values of the snapshot, and the texts.
Needs foxglove-sdk, the extra `foxglove` of this package.
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Sequence
from typing import Any

FRAME, BODY = "local", "vehicle"
BACKLOG = 100  # messages that a client may be late; then it loses the oldest
_NICENESS = 5
_HALF = math.sqrt(0.5)
_NED_TO_ENU, _FLU_TO_FRD = (0.0, _HALF, _HALF, 0.0), (0.0, 1.0, 0.0, 0.0)


def enu(ned: Sequence[float]) -> tuple[float, float, float]:
    """East, north, up of north, east, down."""
    return ned[1], ned[0], -ned[2]


def attitude_enu(quaternion: Sequence[float]) -> tuple[float, ...]:
    """(w, x, y, z) from forward, left, up to east, north, up, of one from FRD to NED."""
    return _product(_product(_NED_TO_ENU, quaternion), _FLU_TO_FRD)


def _product(a: Sequence[float], b: Sequence[float]) -> tuple[float, ...]:
    """Hamilton product of two quaternions (w, x, y, z)."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


class Publisher:
    """Logs snapshots to the channels of the SDK."""

    def __init__(self) -> None:
        import foxglove
        from foxglove import channels

        self._snapshot = foxglove.Channel("/snapshot", message_encoding="json")
        self._vehicle = channels.PoseInFrameChannel("/vehicle")
        self._reference = channels.PoseInFrameChannel("/reference")
        self._frames = channels.FrameTransformsChannel("/tf")
        self._texts = channels.LogChannel("/texts")
        self._told: list[str] = []

    def publish(self, snapshot: dict[str, Any]) -> None:
        """One snapshot, as `values.as_dict` makes it."""
        from foxglove.messages import FrameTransform, FrameTransforms, Log, LogLevel

        self._snapshot.log(snapshot)
        position, attitude = snapshot["position_ned_m"], snapshot["attitude"]
        if position and attitude:
            at, turn = _vector(enu(position)), _quaternion(attitude_enu(attitude))
            self._vehicle.log(_pose(at, turn))
            transform = FrameTransform(
                parent_frame_id=FRAME, child_frame_id=BODY, translation=at, rotation=turn
            )
            self._frames.log(FrameTransforms(transforms=[transform]))
        if snapshot["reference_ned_m"]:
            level = _quaternion((1.0, 0.0, 0.0, 0.0))
            self._reference.log(_pose(_vector(enu(snapshot["reference_ned_m"])), level))
        texts = snapshot["texts"]
        for text in texts[_overlap(self._told, texts) :]:
            self._texts.log(Log(level=LogLevel.Info, name="offboard", message=text))
        self._told = texts


def _overlap(told: list[str], texts: list[str]) -> int:
    """How many of the first `texts` are the last of `told`."""
    longest = min(len(told), len(texts))
    return next((n for n in range(longest, 0, -1) if told[-n:] == texts[:n]), 0)


def _vector(values: Sequence[float]) -> Any:
    from foxglove.messages import Vector3

    return Vector3(x=values[0], y=values[1], z=values[2])


def _quaternion(values: Sequence[float]) -> Any:
    from foxglove.messages import Quaternion

    return Quaternion(w=values[0], x=values[1], y=values[2], z=values[3])


def _pose(at: Any, turn: Any) -> Any:
    from foxglove.messages import Pose, PoseInFrame

    return PoseInFrame(frame_id=FRAME, pose=Pose(position=at, orientation=turn))


def main(host: str, port: int) -> None:
    """Serve until stdin closes."""
    try:
        import foxglove
    except ImportError:
        _answer(error="foxglove-sdk is missing: pip install 'pso-offboard[foxglove]'")
        return
    try:
        server = foxglove.start_server(
            name="offboard", host=host, port=port, message_backlog_size=BACKLOG
        )
    except (OSError, RuntimeError) as error:
        _answer(error=f"{host}:{port} cannot be listened on ({error}); choose another address")
        return
    publisher = Publisher()
    _answer(url=f"ws://{host}:{server.port}")
    for text in sys.stdin:
        publisher.publish(json.loads(text))
    server.stop()


def _answer(**answer: str) -> None:
    print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    os.nice(_NICENESS)  # the controller goes first
    main(sys.argv[1], int(sys.argv[2]))
