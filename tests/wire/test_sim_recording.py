"""A real PX4's recording asked again: the same bytes at the same vehicle times to the simulator.

Every answer is compared row by row; what may differ is listed here with its reason.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink
from sim_bench import Bench

from simulator.sensors import EstimatorName

RECORDING = Path(__file__).parent / "recordings" / "px4-1.16.1-offboard.tlog"
VEHICLE, COMPANION = (7, 1), (7, 191)
NOT_OURS = "[logger]"  # PX4 announces its log file; the simulator writes none


class Talk:
    """What an autopilot said, in rows that can be compared."""

    def __init__(self) -> None:
        self.acks: list[tuple[int, int, float]] = []
        self.texts: list[tuple[int, str, float]] = []
        self.parameters: list[tuple[str, bytes, int]] = []
        self.states: list[tuple[int, int, int]] = []
        self.landed: list[int] = []
        self._open_text = ""

    def hear(self, time_s: float, message: Any) -> None:
        kind = message.get_type()
        if kind == "COMMAND_ACK":
            self.acks.append((message.command, message.result, time_s))
        elif kind == "STATUSTEXT":
            self._hear_text(time_s, message)
        elif kind == "PARAM_VALUE" and time_s > 2.0:  # before: PX4's unasked list of changes
            self.parameters.append(
                (message.param_id, struct.pack("<f", message.param_value), message.param_type)
            )
        elif kind == "HEARTBEAT":
            state = (message.custom_mode, message.base_mode, message.system_status)
            if state not in self.states[-1:]:
                self.states.append(state)
        elif kind == "EXTENDED_SYS_STATE" and message.landed_state not in self.landed[-1:]:
            self.landed.append(message.landed_state)

    def _hear_text(self, time_s: float, message: Any) -> None:
        self._open_text += message.text
        if len(message.text) < 50:
            if not self._open_text.startswith(NOT_OURS):
                self.texts.append((message.severity, self._open_text, time_s))
            self._open_text = ""


def recorded_frames() -> list[tuple[float, bytes, Any]]:
    """Host seconds since the first, frame, and the message if pymavlink knows it."""
    data, frames, at = RECORDING.read_bytes(), [], 0
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    first_us = struct.unpack_from(">Q", data)[0]
    while at < len(data):
        (stamp_us,) = struct.unpack_from(">Q", data, at)
        frame = data[at + 8 : at + 20 + data[at + 9]]
        frames.append(((stamp_us - first_us) * 1e-6, frame, parser.parse_char(frame)))
        at += 8 + len(frame)
    return frames


@pytest.fixture(scope="module")
def talks() -> tuple[Talk, Talk]:
    """The real one's talk and the simulator's."""
    real, ours = Talk(), Talk()
    bench = Bench(EstimatorName.PX4_LIKE, seed=2, heartbeat_type=None, system=VEHICLE[0])
    offset_s = 0.0  # vehicle time minus host time, from the newest stamp
    for host_s, frame, message in recorded_frames():
        if message is None:
            continue
        source = (message.get_srcSystem(), message.get_srcComponent())
        if source == VEHICLE:
            if message.get_type() == "ATTITUDE":
                offset_s = message.time_boot_ms / 1000 - host_s
            real.hear(host_s + offset_s, message)
        elif source == COMPANION:
            bench.run(max(0.0, host_s + offset_s - bench.time_s))
            bench.instance.feed(frame)
    bench.run(20.0)  # the recording ends after its last question
    for time_s, message in bench.received:
        ours.hear(time_s, message)
    return real, ours


def test_every_ack_is_the_same_in_order(talks: tuple[Talk, Talk]) -> None:
    real, ours = talks
    assert [row[:2] for row in ours.acks] == [row[:2] for row in real.acks]
    assert len(real.acks) == 14
    late = [abs(a[2] - b[2]) for a, b in zip(ours.acks, real.acks, strict=True)]
    assert max(late) < 0.06  # vehicle time is known to some ms, the speed of SITL wavers


def test_every_text_is_the_same_in_order(talks: tuple[Talk, Talk]) -> None:
    """Their times too, but for what hangs on the takeoff ramp and on the height landed from."""
    real, ours = talks
    assert [row[:2] for row in ours.texts] == [row[:2] for row in real.texts]
    assert len(real.texts) == 9
    for (_, text, our_s), (_, _, real_s) in zip(ours.texts, real.texts, strict=True):
        free = text.startswith(("Takeoff", "Landing detected", "Disarmed by landing"))
        assert abs(our_s - real_s) < (6.0 if free else 0.06), text


def test_every_parameter_is_the_same(talks: tuple[Talk, Talk]) -> None:
    real, ours = talks
    assert ours.parameters == real.parameters
    assert len(real.parameters) == 7


def test_heartbeats_go_through_the_same_states(talks: tuple[Talk, Talk]) -> None:
    real, ours = talks
    assert ours.states == real.states
    assert len(real.states) == 11


def test_landed_states_are_the_same(talks: tuple[Talk, Talk]) -> None:
    real, ours = talks
    assert ours.landed == real.landed == [1, 2, 4, 1]
