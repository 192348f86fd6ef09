"""Recorded sessions with real autopilots, repeated with the simulated one and compared row by row:
equal, different and late rows."""

from __future__ import annotations

import difflib
import re
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sim_bench import Bench
from vehicle_frames import recorded

COMPANION_COMPONENT = 191
# HEARTBEAT, PARAM_VALUE, LOCAL_POSITION_NED, MISSION_..., COMMAND_ACK, EKF_STATUS_REPORT,
# EXTENDED_SYS_STATE, STATUSTEXT
HEARD = frozenset({0, 22, 32, 40, 44, 46, 47, 51, 77, 193, 245, 253})
TEXT_CHUNK = 50
BRIEF_S = 1.2  # a state that lasts less may fall between two heartbeats
KINDS = ("ack", "text", "state", "landed", "filter", "param", "mission")


@dataclass
class Rows:
    """What one autopilot sent: rows of each kind in order, as (time, text), without repeated
    states, and its path, as (time, position, velocity), both north, east, down."""

    by_kind: dict[str, list[tuple[float, str]]] = field(
        default_factory=lambda: {kind: [] for kind in KINDS}
    )
    path: list[tuple[float, ...]] = field(default_factory=list)
    _open_text: str = ""

    def hear(self, time_s: float, message: Any) -> None:
        name = message.get_type()
        if name == "COMMAND_ACK":
            self._add("ack", time_s, f"{message.command}: {message.result}")
        elif name == "STATUSTEXT":
            self._open_text += message.text
            if len(message.text) < TEXT_CHUNK:
                text = _without_figures(self._open_text)
                per_setpoint = text.startswith("SET_POSITION_TARGET")
                add = self._change if per_setpoint else self._add
                add("text", time_s, f"{message.severity} {text}")
                self._open_text = ""
        elif name == "HEARTBEAT":
            state = f"{message.base_mode} {message.custom_mode:#x} {message.system_status}"
            self._change("state", time_s, state)
        elif name == "EXTENDED_SYS_STATE":
            self._change("landed", time_s, str(message.landed_state))
        elif name == "EKF_STATUS_REPORT":
            self._change("filter", time_s, str(message.flags))
        elif name == "LOCAL_POSITION_NED":
            m = message
            self.path.append((time_s, m.x, m.y, m.z, m.vx, m.vy, m.vz))
        elif name == "PARAM_VALUE":
            bits = struct.pack("<f", message.param_value).hex()
            self._change("param", time_s, f"{message.param_id} {bits} {message.param_type}")
        elif name in ("MISSION_ACK", "MISSION_COUNT", "MISSION_ITEM_REACHED"):
            what = getattr(message, {"A": "type", "C": "count", "I": "seq"}[name[8]])
            self._change("mission", time_s, f"{name} {what}")
        elif name.startswith("MISSION_REQUEST"):
            self._change("mission", time_s, f"{name} {message.seq}")

    def _add(self, kind: str, time_s: float, what: str) -> None:
        self.by_kind[kind].append((time_s, what))

    def _change(self, kind: str, time_s: float, what: str) -> None:
        if self.by_kind[kind][-1:] == [] or self.by_kind[kind][-1][1] != what:
            self._add(kind, time_s, what)


@dataclass(frozen=True)
class Comparison:
    """`equal`: count of equal rows; `differing`: rows of one side, "real ..." or "ours ...";
    `late`: each equal row, and how many seconds later ours is."""

    equal: int
    differing: list[str]
    late: list[tuple[str, float]]


def compare(real: Rows, ours: Rows, kinds: Iterable[str], unheard: tuple[str, ...]) -> Comparison:
    """Compare rows of these kinds in order, without those that contain one of `unheard`."""
    equal, differing, late = 0, [], []
    for kind in kinds:
        sides = [
            [row for row in _lasting(side, kind) if not any(part in row[1] for part in unheard)]
            for side in (real, ours)
        ]
        theirs, mine = ([row[1] for row in side] for side in sides)
        matcher = difflib.SequenceMatcher(None, theirs, mine, autojunk=False)
        for how, a, b, c, d in matcher.get_opcodes():
            if how == "equal":
                equal += b - a
                late += [
                    (f"{kind} {x[1]}", y[0] - x[0])
                    for x, y in zip(sides[0][a:b], sides[1][c:d], strict=True)
                ]
            else:
                differing += [f"real {kind} {row}" for row in theirs[a:b]]
                differing += [f"ours {kind} {row}" for row in mine[c:d]]
    return Comparison(equal, differing, late)


def _lasting(side: Rows, kind: str) -> list[tuple[float, str]]:
    rows = side.by_kind[kind]
    if kind != "state":
        return rows
    lasting: list[tuple[float, str]] = []
    for row, (until_s, _) in zip(rows, [*rows[1:], (float("inf"), "")], strict=True):
        if until_s - row[0] > BRIEF_S and [row[1]] != [last[1] for last in lasting[-1:]]:
            lasting.append(row)
    return lasting


def _without_figures(text: str) -> str:
    """`text`, with # for each figure if it tells the charge, which is an estimate."""
    estimated = text.startswith("Battery 1 is")
    return re.sub(r"\d+(\.\d+)?", "#", text).strip() if estimated else text.strip()


def ask_again(
    recording: Path,
    bench: Bench,
    real: Any,
    ours: Any,
    run_on_s: float,
    each: Callable[[Any], None] = lambda message: None,
) -> None:
    """Send `bench` what the recorded companion sent, at the same vehicle times; `real` and `ours`
    `hear` what the recorded and the simulated autopilot answer.

    `run_on_s`: time that the simulator runs after the last request. `each` is called with the
    messages of the real autopilot, in the order of time.
    """
    system = bench.system
    offset_s = 0.0  # vehicle time minus host time, from the newest stamp
    for host_s, frame, message in recorded(recording):
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
