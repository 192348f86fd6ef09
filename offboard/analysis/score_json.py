"""A score as JSON: what `score --json` prints and score.json holds."""

from __future__ import annotations

import json
from typing import Any

from offboard.analysis.events import Event
from offboard.analysis.history import History
from offboard.analysis.score import Score
from offboard.documents.plain import plain


def as_text(score: Score, history: History) -> str:
    """All figures, the events and the number of messages as JSON text; a figure that the log does
    not hold is null."""
    document = {
        "ended_by": score.ended_by,
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
