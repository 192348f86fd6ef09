"""The page of a report: verdict, then path, timeline and panels, events and metrics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from offboard.analysis.page import render
from offboard.analysis.score import METRICS
from offboard.analysis.score_table import summary, verdict
from offboard.report.figures import figures, side_by_side
from offboard.report.flight import Flight

_SIGNS = {1.0: ("good", "✓"), 0.0: ("bad", "✗")}


def page(flights: Sequence[Flight], fits: Mapping[str, Any] | None = None) -> str:
    """Return the HTML page of one flight or of several. `fits` is the result of `fits.fits`, or
    None without an identification."""
    flights, alone = side_by_side(flights), len(flights) == 1
    title = f"Flight {flights[0].name}" if alone else f"{len(flights)} flights side by side"
    return render(
        "report/templates/report.html",
        title=title,
        verdicts=[_verdict(flight) for flight in flights],
        figures=figures(flights),
        fits=fits,
        rows=rows(flights),
        metrics=METRICS,
        letters=[] if alone else [flight.letter for flight in flights],
        events=flights[0].history.events() if alone else [],
    )


def _verdict(flight: Flight) -> dict[str, object]:
    kind, sign = _SIGNS.get(flight.score.completed, ("unknown", "–"))
    return {
        "kind": kind,
        "sign": sign,
        "sentence": verdict(flight.score),
        "name": flight.label,
        "rows": summary(flight.score, flight.history) | flight.facts,
        "missing": flight.missing,
    }


def rows(flights: Sequence[Flight]) -> dict[str, tuple[str, ...]]:
    """Return each metric that is known of any flight, by name, with a text for each flight."""
    scores = [flight.score.metrics() for flight in flights]
    return {
        name: tuple(f"{each:.4g}" if math.isfinite(each) else "–" for each in values)
        for name in METRICS
        if any(map(math.isfinite, values := [score[name] for score in scores]))
    }
