"""Recorded sessions with real autopilots, repeated with the simulated one."""

from __future__ import annotations

import lzma
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_bench import Bench

COMPANION_COMPONENT = 191
# HEARTBEAT, PARAM_VALUE, LOCAL_POSITION_NED, MISSION_..., COMMAND_ACK, EKF_STATUS_REPORT,
# EXTENDED_SYS_STATE, STATUSTEXT
HEARD = frozenset({0, 22, 32, 40, 44, 46, 47, 51, 77, 193, 245, 253})


def recorded_frames(recording: Path) -> list[tuple[float, bytes, Any]]:
    """Host seconds since the first, frame, and the message if pymavlink knows it."""
    data, frames, at = recording.read_bytes(), [], 0
    if recording.suffix == ".xz":
        data = lzma.decompress(data)
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    first_us = struct.unpack_from(">Q", data)[0]
    while at < len(data):
        (stamp_us,) = struct.unpack_from(">Q", data, at)
        frame = data[at + 8 : at + 20 + data[at + 9]]
        frames.append(((stamp_us - first_us) * 1e-6, frame, parser.parse_char(frame)))
        at += 8 + len(frame)
    return frames


def ask_again(
    recording: Path,
    bench: Bench,
    real: Any,
    ours: Any,
    run_on_s: float,
    each: Callable[[Any], None] = lambda message: None,
) -> None:
    """Send what the companion sent, at the same vehicle times; both sides `hear` the answers.

    `run_on_s`: how long the simulator runs after the last request. `each` receives the messages
    of the real autopilot, in order of time.
    """
    system = bench.system
    offset_s = 0.0  # vehicle time minus host time, from the newest stamp
    for host_s, frame, message in recorded_frames(recording):
        if message is None:
            continue
        source = (message.get_srcSystem(), message.get_srcComponent())
        if source == (system, 1):
            if message.get_type() == "ATTITUDE":
                offset_s = message.time_boot_ms / 1000 - host_s
            real.hear(host_s + offset_s, message)
            each(message)
        elif source == (system, COMPANION_COMPONENT):
            bench.run(max(0.0, host_s + offset_s - bench.time_s))
            bench.instance.feed(frame)
    bench.run(run_on_s)
    for time_s, message in bench.received_of(HEARD):
        ours.hear(time_s, message)
