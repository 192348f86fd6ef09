"""Messages of an autopilot in comparable rows, and recordings to repeat."""

from __future__ import annotations

import lzma
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_bench import Bench

COMPANION_COMPONENT = 191
# HEARTBEAT, PARAM_VALUE, LOCAL_POSITION_NED, MISSION_..., COMMAND_ACK, EKF_STATUS_REPORT,
# EXTENDED_SYS_STATE, STATUSTEXT
HEARD = frozenset({0, 22, 32, 40, 44, 46, 47, 51, 77, 193, 245, 253})


class Talk:
    """One autopilot's side of a talk. `unheard`: beginnings of texts that are left out."""

    def __init__(self, unheard: tuple[str, ...] = ()) -> None:
        self.acks: list[tuple[int, int, float]] = []
        self.texts: list[tuple[int, str, float]] = []
        self.parameters: list[tuple[str, bytes, int]] = []
        self.parameter_numbers: list[int] = []
        self.states: list[tuple[int, int, int]] = []
        self.state_times_s: list[float] = []
        self.landed: list[int] = []
        self.landed_times_s: list[float] = []
        self.filter_flags: list[int] = []
        self.filter_times_s: list[float] = []
        self.positions_ned_m: list[tuple[float, float, float, float]] = []
        self._unheard = unheard
        self._open_text = ""

    def hear(self, time_s: float, message: Any) -> None:
        kind = message.get_type()
        if kind == "COMMAND_ACK":
            self.acks.append((message.command, message.result, time_s))
        elif kind == "STATUSTEXT":
            self._hear_text(time_s, message)
        elif kind == "PARAM_VALUE":
            self.parameters.append(
                (message.param_id, struct.pack("<f", message.param_value), message.param_type)
            )
            self.parameter_numbers.append(message.param_index)
        elif kind == "HEARTBEAT":
            state = (message.custom_mode, message.base_mode, message.system_status)
            _note_change(self.states, self.state_times_s, state, time_s)
        elif kind == "EXTENDED_SYS_STATE":
            _note_change(self.landed, self.landed_times_s, message.landed_state, time_s)
        elif kind == "EKF_STATUS_REPORT":
            _note_change(self.filter_flags, self.filter_times_s, message.flags, time_s)
        elif kind == "LOCAL_POSITION_NED":
            self.positions_ned_m.append((time_s, message.x, message.y, message.z))

    def _hear_text(self, time_s: float, message: Any) -> None:
        self._open_text += message.text
        if len(message.text) < 50:
            if not self._open_text.startswith(self._unheard or ("\0",)):
                self.texts.append((message.severity, self._open_text, time_s))
            self._open_text = ""


def _note_change(rows: list[Any], times_s: list[float], row: Any, time_s: float) -> None:
    if row not in rows[-1:]:
        rows.append(row)
        times_s.append(time_s)


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


class Listener(Protocol):
    """Receives the messages of an autopilot."""

    def hear(self, time_s: float, message: Any) -> None: ...


def ask_again(
    recording: Path,
    bench: Bench,
    real: Listener,
    ours: Listener,
    run_on_s: float,
    each: Callable[[Any], None] = lambda message: None,
) -> None:
    """Send what the companion sent, at the same vehicle times; both talks are filled.

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
