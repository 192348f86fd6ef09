"""`offboard score`: every metric of a flight, from its log."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from offboard.cli.shared import FLIGHT, Requirements, complain, out
from offboard.documents.errors import UserError

if TYPE_CHECKING:
    from offboard.analysis.history import History
    from offboard.analysis.score import Requirement, Score

EXIT_CODES = (
    "Exit codes: 0 scored and all requirements met; 1 a requirement missed; 2 usage error, or the "
    "log cannot be read."
)


def score(
    flight: Annotated[Path, FLIGHT],
    as_json: Annotated[bool, typer.Option("--json", help="Print the score as JSON.")] = False,
    require: Requirements = None,
) -> None:
    """Score a flight from its .tlog alone.

    Prints whether the flight was completed, what happened in the order of time, then every metric.
    Every requirement on a flight that was not completed is missed. Writes score.json if FLIGHT is a
    directory.
    """
    from offboard.analysis.score import as_text
    from offboard.analysis.score_table import show, verdict

    requirements = requirements_of(require)
    result, history = scored(flight)
    if as_json:
        sys.stdout.write(as_text(result, history))
    else:
        show(out, result, history)
    if history.damage:
        complain(history.damage)
    figures = result.metrics()
    missed = [each.sentence(figures) for each in requirements if not each.met(figures)]
    if requirements and result.completed != 1.0:
        missed.insert(0, verdict(result))
    if missed:
        raise UserError("; ".join(missed), 1)


def requirements_of(texts: list[str] | None) -> list[Requirement]:
    """The requirements of --require. Raises UserError."""
    from offboard.analysis.score import Requirement

    return [Requirement.parse(text) for text in texts or ()]


def scored(flight: Path) -> tuple[Score, History]:
    """Score a flight and keep the score in its directory. Raises TlogError."""
    from offboard.analysis.score import score_flight

    result, history = score_flight(flight)
    keep(flight, result, history)
    return result, history


def keep(flight: Path, result: Score, history: History) -> None:
    """Write score.json if `flight` is a directory. Where it cannot be written, say so."""
    from offboard.analysis.score import keep_score
    from offboard.link.log import LogError

    if flight.is_dir():
        try:
            keep_score(flight, result, history)
        except LogError as error:
            complain(str(error))
