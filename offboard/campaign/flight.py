"""Flies one case in a worker, in memory and in lockstep, and scores it from its log.

The flight is the same as that of `offboard fly --sitl` with the same options, byte for byte. The
record of a flight at a link is made in the same way (`recorded`).

The robustness margin of a flight says how far it stayed from breaking a promise. Each term is 1 if
none of its limit was used (clearance: at twice the limit), 0 at the limit, and negative beyond it.
The margin is the smallest term. It is at most `NOT_COMPLETED` if the flight was not completed
(landed early, handed back, crashed).

| term | measured value | limit |
|---|---|---|
| error | largest position error while tracking, as the vehicle estimates it | `error_m` |
| tilt | largest tilt while tracking | `tilt_deg` |
| clearance | least true distance to the controller's keep-out volumes | `clearance_m` |
| age | round-trip delay of the link (TIMESYNC) in the whole flight, 99th percentile | `age_s` |
| authority | share of decisions at a limit of control law or vehicle | `at_bound` |
| touchdown | downward speed at touch-down | `touchdown_mps` |
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from offboard.analysis.history import History
from offboard.analysis.score import judged, keep_score, score_flight
from offboard.analysis.verdict import begin_times
from offboard.campaign.cases import Case
from offboard.campaign.document import Promises
from offboard.campaign.results import INFEASIBLE, Record, code_hash
from offboard.control.base import ControllerSettings
from offboard.control.keep_out import clearances
from offboard.documents.errors import DocumentError, UserError
from offboard.flight.phases import ExitCode, Outcome
from offboard.link.log import LogError
from offboard.link.stop import StopRequests
from offboard.run.configuration import FlightConfig
from offboard.run.flight import fly
from offboard.run.sitl import InMemorySimulator

NOT_COMPLETED = -1.0
NOT_FLOWN = -2.0  # margin of a case that could not be flown, or whose process crashed
LOWEST = -9.0  # terms are limited to this, so that one diverged flight does not hide all others


@dataclass(frozen=True, slots=True)
class Job:
    """A case and what its worker needs to fly it. `code` is the hash of the campaign's code. `kept`
    is the directory for the log; without it the log is deleted. The directory is created when the
    flight is complete; one that exists already is not changed."""

    case: Case
    promises: Promises
    code: str
    kept: Path | None = None


def fly_job(job: Job) -> Record:
    """Fly a case and return its record, also if the flight fails. Raises UserError."""
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
            record = recorded(job, directory, partial(_fly, job.case, Path(scratch)))
            if job.kept and directory.exists() and not job.kept.exists():
                directory.rename(job.kept)
            return replace(record, sentence=record.sentence.replace(f"{scratch}/", ""))
    except (OSError, LogError) as error:
        raise UserError(f"a worker cannot go on: {error}") from None


def recorded(job: Job, directory: Path, fly: Callable[[FlightConfig, Path], Outcome]) -> Record:
    """Fly a case by `fly`, score its log, write score.json beside the log, and return the record.

    `fly` flies a configuration and writes its log into a directory. A flight that fails has a
    record, too. Raises UserError if no flight can be flown or recorded at present, for example for
    lack of memory or of the link.
    """
    try:
        config = job.case.load()
        outcome = fly(config, directory)
        score, history = score_flight(directory)
    except (OSError, MemoryError) as error:
        raise UserError(f"no flight can be flown here: {str(error) or 'out of memory'}") from None
    except UserError as error:
        if not (isinstance(error, DocumentError) and error.code == DocumentError.code):
            raise  # the cause is not the case, so that no other case could be flown either
        sentence = " ".join(str(error).split())
        return Record(ExitCode.USAGE, sentence, NOT_FLOWN, INFEASIBLE)
    except Exception as error:
        sentence = f"{type(error).__name__}: {error}"
        return Record(ExitCode.ABORTED, sentence, NOT_FLOWN, "crash")
    keep_score(directory, score, history)
    outcome, metrics = judged(outcome, score), score.metrics()
    margins = terms(job.promises, metrics, history, config.controller)
    weakest = min(margins, key=lambda name: margins[name])
    return Record(
        outcome.exit_code,
        outcome.sentence,
        margins[weakest],
        weakest,
        {name: value for name, value in metrics.items() if math.isfinite(value)},
    )


def _fly(case: Case, scratch: Path, config: FlightConfig, directory: Path) -> Outcome:
    scenario = case.scenario
    if text := case.scenario_text:
        path = scratch / case.scenario_file
        path.parent.mkdir()
        path.write_text(text, encoding="utf-8")
        scenario = str(path)
    outcome = fly(
        config,
        directory,
        case.simulated(scenario),
        simulator=InMemorySimulator(),
        stops=StopRequests(),  # not entered: only the main process handles signals
    )
    if outcome.log_problem:
        raise LogError(outcome.log_problem)
    return outcome


def terms(
    promises: Promises,
    metrics: Mapping[str, float],
    flown: History,
    controller: ControllerSettings,
) -> dict[str, float]:
    """Return the terms of the margin by name, without those for which the log has no data."""
    used = {
        "error": metrics["max_position_m"] / promises.error_m,
        "tilt": metrics["tilt_max_deg"] / promises.tilt_deg,
        "age": 1e-3 * metrics["link_delay_p99_ms"] / promises.age_s,
        "authority": metrics["at_bound_share"] / promises.at_bound,
        "touchdown": metrics["touchdown_mps"] / promises.touchdown_mps,
    }
    margins = {name: 1.0 - share for name, share in used.items()}
    margins["clearance"] = _clearance(flown, controller) / promises.clearance_m - 1.0
    if metrics["completed"] != 1.0:
        margins["completed"] = NOT_COMPLETED
    return {
        name: max(LOWEST, min(1.0, value))
        for name, value in margins.items()
        if not math.isnan(value)
    }


def _clearance(flown: History, controller: ControllerSettings) -> float:
    """Return the least distance to a keep-out volume in metres since TRACK began; NaN without
    volumes or positions. By true positions, or estimated ones if the log has no true ones."""
    volumes = getattr(controller, "keep_out", ())
    begun_s = begin_times(flown.phases[::-1]).get("track")
    path = flown.truth if len(flown.truth) else flown.position
    if not volumes or begun_s is None or not len(path):
        return math.nan
    rows = path[path["time_s"] >= begun_s]
    if not len(rows):
        return math.nan
    places = rows["position_ned_m"].astype(np.float64)
    from_start = places - path["position_ned_m"][0]
    return float(np.min(clearances(volumes, rows["time_s"] - begun_s, from_start)))
