"""The score of one flight: computed from its log, judged, and kept as JSON beside it."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from offboard.analysis import tlog
from offboard.analysis.events import Event
from offboard.analysis.history import History, gather
from offboard.analysis.score import Score, score
from offboard.documents.plain import plain
from offboard.flight.flight import Outcome
from offboard.flight.phases import ExitCode
from offboard.link.log import LogError


def score_flight(flight: Path) -> tuple[Score, History]:
    """Score a flight from its log alone.

    `flight` is a flight directory or a .tlog file. Returns the values, and columns and events of
    the log. Raises TlogError.

    Example:

        score, history = score_flight(Path("flights/20261121-093000"))
        print(score.rmse_position_m, history.phases)
    """
    flown = gather(tlog.read(tlog.find(flight)))
    return score(flown), flown


def judged(outcome: Outcome, score: Score) -> Outcome:
    """The outcome of a flight by what its log shows: one that is not completed was aborted."""
    if outcome.exit_code != ExitCode.FLOWN or score.completed == 1.0:
        return outcome
    return Outcome(ExitCode.ABORTED, f"{outcome.sentence}, but not completed: {score.ended_by}")


def keep_score(directory: Path, score: Score, flown: History) -> None:
    """Write score.json into a flight directory; a score that is there stays until the new one is
    complete. Raises LogError."""
    path, incomplete = directory / "score.json", directory / "score.json.part"
    try:
        incomplete.write_text(as_text(score, flown), encoding="utf-8")
        incomplete.replace(path)
    except OSError as error:
        with suppress(OSError):
            incomplete.unlink()
        raise LogError(f"{path} cannot be written ({error.strerror})") from None


def as_text(score: Score, history: History) -> str:
    """All figures, the events and the number of messages as JSON text; a figure that the log does
    not hold is null."""
    document = {
        "ended_by": score.ended_by,
        "reason": score.reason,
        **score.figures(),
        "phases": _events(history.phases),
        "modes": _events(history.modes),
        "vehicle_messages": _events(history.vehicle_messages),
        "messages": dict(sorted(history.messages.items())),
        "wall_s": history.wall_s,
        "damage": history.damage,
    }
    return json.dumps(plain(document), indent=2, allow_nan=False) + "\n"


def _events(events: tuple[Event, ...]) -> list[dict[str, Any]]:
    return [{"time_s": event.time_s, "what": event.what} for event in events]
