"""One case flown in a worker: in memory, in lockstep, scored from its log.

The flight is that of `offboard fly --sitl` with the same options, byte for byte. A record of any
other flight is made in the same way (`recorded`).
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from offboard.analysis.flight_score import judged, keep_score, score_flight
from offboard.campaign.cases import Case
from offboard.campaign.margin import NOT_FLOWN, Promises, terms
from offboard.campaign.results import Record, code_hash
from offboard.documents.errors import UserError
from offboard.flight.flight import Outcome
from offboard.flight.phases import ExitCode
from offboard.link.log import LogError
from offboard.link.stop import StopRequests
from offboard.run.configuration import FlightConfig
from offboard.run.flight import fly
from offboard.run.in_memory import InMemorySimulator


@dataclass(frozen=True, slots=True)
class Job:
    """A case with what its worker needs. `code` is the campaign's; `kept`: the directory for the
    log, which is otherwise deleted. It appears when the flight is complete, and stays if it exists
    already."""

    case: Case
    promises: Promises
    code: str
    kept: Path | None = None


def fly_job(job: Job) -> Record:
    """Fly a case. A flight that fails is a record too. Raises UserError."""
    if code_hash() != job.code:
        raise UserError(
            f"a worker runs other code ({code_hash()}) than this campaign ({job.code}); install "
            "the same version there and start it again"
        )
    try:
        if job.kept:
            job.kept.parent.mkdir(parents=True, exist_ok=True)
        place = job.kept.parent if job.kept else None
        with tempfile.TemporaryDirectory(prefix=".offboard-", dir=place) as scratch:
            directory = Path(scratch) / "flight"
            record = recorded(
                job.case.load, directory, job.promises, partial(_fly, job.case, Path(scratch))
            )
            if job.kept and directory.exists() and not job.kept.exists():
                directory.rename(job.kept)
            return replace(record, sentence=record.sentence.replace(f"{scratch}/", ""))
    except (OSError, LogError) as error:
        raise UserError(f"a worker cannot go on: {error}") from None


def recorded(
    load: Callable[[], FlightConfig],
    directory: Path,
    promises: Promises,
    fly: Callable[[FlightConfig, Path], Outcome],
) -> Record:
    """The record of a flight from its log, with score.json beside the log.

    `fly` flies the configuration that `load` returns, and logs it in `directory`. A flight that
    fails is a record too. Raises UserError where none can be flown or recorded, for lack of memory
    or disk space.
    """
    try:
        config = load()
        outcome = fly(config, directory)
        score, history = score_flight(directory)
    except LogError:
        raise
    except (OSError, MemoryError) as error:
        raise UserError(f"no flight can be flown here: {str(error) or 'out of memory'}") from None
    except UserError as error:
        sentence = " ".join(str(error).split())
        return Record(ExitCode.USAGE, sentence, NOT_FLOWN, "infeasible")
    except Exception as error:
        sentence = f"{type(error).__name__}: {error}"
        return Record(ExitCode.ABORTED, sentence, NOT_FLOWN, "crash")
    keep_score(directory, score, history)
    outcome, figures = judged(outcome, score), score.figures()
    margins = terms(promises, figures, history, config.controller)
    weakest = min(margins, key=lambda name: margins[name])
    return Record(
        outcome.exit_code,
        outcome.sentence,
        margins[weakest],
        weakest,
        {name: value for name, value in figures.items() if math.isfinite(value)},
        margins,
    )


def _fly(case: Case, scratch: Path, config: FlightConfig, directory: Path) -> Outcome:
    scenario = case.scenario
    if case.text:
        path = scratch / case.scenario_file
        path.parent.mkdir()
        path.write_text(case.text, encoding="utf-8")
        scenario = str(path)
    outcome = fly(
        config,
        directory,
        case.simulated(scenario),
        simulator=InMemorySimulator(),
        stops=StopRequests(),  # not entered: signals are the main process's
    )
    if outcome.log_problem:
        raise LogError(outcome.log_problem)
    return outcome
