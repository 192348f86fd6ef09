"""The flight for Foxglove and Lichtblick: `python -m offboard.live.foxglove_server HOST PORT`.

Snapshots as JSON lines on stdin become messages of a Foxglove WebSocket server: poses of vehicle
and reference in the frame "local" (east, north, up; m), all values of the snapshot, and the texts.
Needs foxglove-sdk, the extra `foxglove` of this package.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any

from offboard.model.frames import Array, enu, flu_in_enu

FRAME, BODY = "local", "vehicle"
BACKLOG = 100  # messages that a client may be late; then it loses the oldest
_NICENESS = 5


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
            at, turn = _vector(enu(position)), _quaternion(flu_in_enu(attitude))
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


def _vector(values: Array) -> Any:
    from foxglove.messages import Vector3

    return Vector3(x=values[0], y=values[1], z=values[2])


def _quaternion(values: Array | tuple[float, ...]) -> Any:
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
