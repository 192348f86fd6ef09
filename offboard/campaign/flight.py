"""One case flown in a worker: in memory, in lockstep, scored from its log.

The flight is that of `offboard fly --sitl` with the same options, byte for byte.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

from offboard.analysis.history import History
from offboard.analysis.score import Score
from offboard.analysis.trial import judged, keep_score, score_flight
from offboard.campaign.cases import Case
from offboard.campaign.code import code_hash
from offboard.campaign.margin import NOT_FLOWN, Promises, terms
from offboard.campaign.results import Record
from offboard.documents.errors import UserError
from offboard.flight.companion import Outcome
from offboard.flight.phases import ExitCode
from offboard.io.log import FlightLog, LogError
from offboard.io.stop import StopRequests
from offboard.run.configuration import FlightConfig, dump
from offboard.run.in_memory import InMemorySimulator
from offboard.run.one_flight import Bundled, fly
from offboard.run.request import build_parts

# figures that this computer's clock decides: they differ between two runs of one flight
WALL_TIMES = (
    "setpoint_gap_wall_max_s",
    "lateness_p99_ms",
    "lateness_max_ms",
    "solve_time_p50_ms",
    "solve_time_p99_ms",
)


@dataclass(frozen=True, slots=True)
class Job:
    """A case with what its worker needs. `code` is the campaign's; `kept`: a directory for the log,
    which is otherwise deleted."""

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
        with tempfile.TemporaryDirectory(prefix="offboard-") as scratch:
            return _flown(job, Path(scratch))
    except (OSError, MemoryError) as error:
        raise UserError(f"a worker cannot go on: {error}") from None


def _flown(job: Job, scratch: Path) -> Record:
    directory = job.kept or scratch / "flight"
    try:
        config, outcome = _fly(job.case, scratch, directory)
        score, history = score_flight(directory)
    except LogError as error:
        raise UserError(f"a worker cannot go on: {error}") from None
    except UserError as error:
        sentence = " ".join(str(error).split()).replace(f"{scratch}/", "")
        return Record(ExitCode.USAGE, sentence, NOT_FLOWN, "infeasible")
    except Exception as error:
        sentence = f"{type(error).__name__}: {error}"
        return Record(ExitCode.ABORTED, sentence, NOT_FLOWN, "crash")
    if job.kept:
        keep_score(job.kept, score, history)
    return _record(job.promises, config, judged(outcome, score), score, history)


def _fly(case: Case, scratch: Path, directory: Path) -> tuple[FlightConfig, Outcome]:
    scenario = case.scenario
    if case.text:
        path = scratch / case.scenario_file
        path.parent.mkdir()
        path.write_text(case.text, encoding="utf-8")
        scenario = str(path)
    config = case.request(directory).resolve()
    log = FlightLog(directory, dump(config))
    outcome = fly(
        build_parts(config),
        log,
        connection="",
        bundled=Bundled(
            InMemorySimulator(), scenario, config.seed, case.sim_vehicle, case.firmware
        ),
        stops=StopRequests(),  # not entered: signals are the main process's
        progress=lambda companion: None,
    )
    if log.problem:
        raise LogError(log.problem)
    return config, outcome


def _record(
    promises: Promises, config: FlightConfig, outcome: Outcome, score: Score, history: History
) -> Record:
    figures = score.figures()
    margins = terms(promises, figures, history, config.controller)
    weakest = min(margins, key=lambda name: margins[name])
    return Record(
        outcome.exit_code,
        outcome.sentence,
        margins[weakest],
        weakest,
        {name: value for name, value in figures.items() if name not in WALL_TIMES},
        margins,
    )
