"""One flight of a comparison: fly it, score it from its log, keep the score."""

from __future__ import annotations

import atexit
import itertools
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path

from offboard.analysis import history, tlog
from offboard.analysis.compare import Result, Trial
from offboard.analysis.history import History
from offboard.analysis.score import Score, Scoring
from offboard.analysis.score_json import as_text
from offboard.documents.errors import UserError
from offboard.flight.companion import STOPPED, Outcome
from offboard.flight.phases import ExitCode
from offboard.io.log import LogError
from offboard.run.configuration import build_track
from offboard.run.request import FlightRequest, fly_request
from offboard.run.sitl import SimulatorProcess


def score_flight(flight: Path) -> tuple[Score, History]:
    """Score a flight from its log alone.

    `flight` is a flight directory or a .tlog file. Returns the figures and the events. The arrays
    of the history are those of the last minutes of a long flight; `history.gather` gives all of
    them. Raises TlogError.

    Example:

        score, history = score_flight(Path("flights/20261121-093000"))
        print(score.rmse_position_m, history.phases)
    """
    scored = Scoring()
    for flown, until_s in history.stretches(tlog.read(tlog.find(flight))):
        scored.add(flown, until_s)
    return scored.score(flown), flown


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


def check_flyable(
    request: FlightRequest, controllers: Sequence[str], references: Sequence[str]
) -> None:
    """Check every controller with every reference. Raises DocumentError."""
    for controller, reference in itertools.product(controllers, references):
        build_track(_of_trial(request, controller, reference).resolve())


def _of_trial(request: FlightRequest, controller: str, reference: str) -> FlightRequest:
    named = {"controller": controller, "reference": reference}
    return replace(request, choices={**request.choices, **named})


@cache
def _simulator() -> SimulatorProcess:
    """The simulator of this process, for all its flights of a comparison."""
    process = SimulatorProcess().__enter__()
    atexit.register(process.close)
    return process


def fly_trial(request: FlightRequest, trial: Trial) -> Result:
    """Fly one flight of a comparison, configured as `request`.

    A flight that fails is a result too. Unless `request` sets limits.begin_armed, an armed vehicle
    is refused: somebody else is flying it.
    """
    requested = replace(
        _of_trial(request, trial.controller, trial.reference),
        assignments=("limits.begin_armed=false", *request.assignments),
        directory=trial.directory,
        scenario=trial.scenario,
        seed=trial.seed,
    )
    try:
        outcome = fly_request(requested, simulator=_simulator() if request.sitl else None)
        score, flown = score_flight(trial.directory)
        keep_score(trial.directory, score, flown)
        outcome = judged(outcome, score)
    except UserError as error:
        return Result(trial, 2, str(error), {})
    stopped = outcome.sentence.startswith(STOPPED)
    return Result(trial, outcome.exit_code, outcome.sentence, score.figures(), stopped)
