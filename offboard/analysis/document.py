"""A score and its story as one JSON document: what `score --json` prints and score.json holds."""

from __future__ import annotations

import json
import math
from typing import Any

from offboard.analysis.history import Event, History
from offboard.analysis.score import Score


def as_document(score: Score, history: History) -> dict[str, Any]:
    """Plain values only; a figure that the log does not hold is null."""
    return {
        **{name: _plain(value) for name, value in score.figures().items()},
        "phases": _story(history.phases),
        "modes": _story(history.modes),
        "said": _story(history.said),
        "messages": dict(sorted(history.messages.items())),
        "wall_s": history.wall_s,
    }


def as_text(score: Score, history: History) -> str:
    """The document as JSON text."""
    return json.dumps(as_document(score, history), indent=2, allow_nan=False) + "\n"


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _story(happenings: tuple[Event, ...]) -> list[dict[str, Any]]:
    return [{"time_s": _plain(one.time_s), "what": one.what} for one in happenings]
