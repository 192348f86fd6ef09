"""Verdict: a replayed flight compared with its log, and what preceded the first difference."""

from __future__ import annotations

from collections.abc import Callable

from offboard.documents.errors import UserError
from offboard.replay.difference import Comparison, Difference, compare
from offboard.replay.recording import Recording
from offboard.replay.replaying import Replay, Turn

FIELDS_MAX = 8
TOLD_EVERY = 500  # turns


def verdict(replay: Replay, tell: Callable[[str], object] = str) -> Comparison:
    """Replay a flight to its end and compare it with its log. `tell` is called with sentences about
    the progress. Raises UserError if nothing can be compared."""
    for turn in replay.turns():
        if turn.number % TOLD_EVERY == 0:
            tell(f"replayed up to {replay.ended_s:.0f} s of vehicle time")
    comparison = compare(replay.recorded, replay.replayed)
    if not comparison.compared.total():
        why = replay.stopped or "the log holds no setpoint and no command"
        raise UserError(f"{replay.recording.log.path}: nothing to compare: {why}")
    return comparison


def explained(recording: Recording, difference: Difference) -> list[str]:
    """What differs, field by field, and the input that preceded it; one line each."""
    name = f"{difference.name} at {difference.time_s:.3f} s"
    if difference.expected is None:
        lines = [f"{name} was not sent in the recorded flight"]
    elif difference.actual is None:
        lines = [f"{name} was not sent in the replay"]
    else:
        lines = [f"{name}:"]
        lines += [
            f"  {field}: {before:.9g} in the log, {after:.9g} in the replay, by {by:.3g}"
            for field, before, after, by in difference.fields()[:FIELDS_MAX]
        ]
    return lines + _input(recording, difference)


def _input(recording: Recording, difference: Difference) -> list[str]:
    """The turn that decided it: replayed once more up to there."""
    replay = Replay(recording)
    number = difference.actual.turn if difference.actual else None
    for turn in replay.turns():
        due = replay.ended_s >= difference.time_s if number is None else turn.number == number
        if due:
            tick = int(replay.ended_s / replay.config.period_s + 1e-6)
            lines = [f"decided in turn {turn.number}, tick {tick}, which was given:"]
            rows = _received(turn) or [("nothing", "no message had arrived")]
            return lines + [f"  {when}: {names}" for when, names in rows]
    return []


def _received(turn: Turn) -> list[tuple[str, str]]:
    """The messages that a turn was given, and how long before it they arrived."""
    frames = iter(turn.received)
    rows: list[tuple[str, str]] = []
    for chunk in turn.given.chunks:
        names = [next(frames).name for _ in range(chunk.frames)]
        age_ms = 1e3 * (turn.given.now_s - chunk.arrived_s)
        rows.append((f"{age_ms:.3f} ms before", ", ".join(names) or "nothing that was used"))
    return rows
