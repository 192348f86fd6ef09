"""Moment: the whole state of the companion at one tick of a replayed flight."""

from __future__ import annotations

import math
from dataclasses import fields

from offboard.analysis.tlog import columns
from offboard.documents.errors import UserError
from offboard.flight.companion import Companion
from offboard.flight.outbox import Output
from offboard.flight.record import FIELDS, LAYOUTS, RECORD_NAME, records_of
from offboard.replay.replaying import Replay, Turn

Rows = list[tuple[str, str]]
LABELS = {"attitude": "attitude (w,x,y,z)"}
HOST_TIMES = ("solve_time_s", "lateness_s")
_FLOAT_ARRAY = 350
_DATA_BYTES = 252  # of DEBUG_FLOAT_ARRAY


def moment_at(replay: Replay, time_s: float) -> dict[str, Rows]:
    """Replay up to the first tick at or after `time_s`, vehicle time. Returns what was received,
    the state, the facts, the ladder, the decision and what was sent, each as names and values.

    Raises UserError where the flight ends before, or its log is damaged.
    """
    period_s, tick = replay.config.period_s, -1
    for turn in replay.turns():
        number = math.floor(replay.ended_s / period_s + 1e-6)
        if number > tick and replay.ended_s >= time_s - 1e-6:
            return _rows(replay, turn)
        tick = max(tick, number)
    ended = f"the recorded flight ends at {replay.ended_s:.3f} s of vehicle time"
    raise UserError(f"--at {time_s:g}: {replay.incomplete or ended}")


def _rows(replay: Replay, turn: Turn) -> dict[str, Rows]:
    companion = replay.companion
    snapshot, facts = companion.snapshot(), companion.facts()
    return {
        f"turn {turn.number}": received(turn),
        "state": [
            (LABELS.get(each.name, each.name), _text(getattr(snapshot, each.name)))
            for each in fields(snapshot)
        ],
        "facts": [
            (each.name, _text(getattr(facts, each.name)))
            for each in fields(facts)
            if each.name != "limits"
        ],
        "ladder, seconds held": _ladder(companion),
        "decision": _decision(turn.output, lockstep=replay.lockstep),
    }


def received(turn: Turn) -> Rows:
    """The messages that a turn was given, and how long before it they arrived."""
    frames = iter(turn.received)
    rows: Rows = []
    for chunk in turn.given.chunks:
        names = [next(frames).name for _ in range(chunk.frames)]
        age_ms = 1e3 * (turn.given.now_s - chunk.arrived_s)
        rows.append((f"{age_ms:.3f} ms before", ", ".join(names) or "nothing that was used"))
    return rows


def _ladder(companion: Companion) -> Rows:
    ladder = companion.state.ladder
    held = [(name, f"{held_s:.3f}") for name, held_s in ladder.held_s.items() if held_s > 0.0]
    return held or [("no condition holds", "")]


def _decision(output: Output | None, *, lockstep: bool) -> Rows:
    """The record of the tick: prediction, command and certificate. In lockstep no host time is
    recorded."""
    left_out = HOST_TIMES if lockstep else ()
    for frame in output.log if output else ():
        if int.from_bytes(frame[7:10], "little") == _FLOAT_ARRAY:
            payload = frame[10:-2].ljust(_DATA_BYTES, b"\0")
            row = columns("DEBUG_FLOAT_ARRAY", payload, "array_id data")
            if payload[10:20].rstrip(b"\0").decode() == RECORD_NAME and row[0, 0] in LAYOUTS:
                record = records_of(row[:, 1:], row[:, 0])[0]
                shown = [name for name in FIELDS if name not in left_out]
                return [(name, _text(float(record[name]))) for name in shown]
    return [("no decision at this tick", "")]


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple):
        return ", ".join(_text(each) for each in value) or "-"
    return "-" if value is None else str(getattr(value, "value", value))
