"""Many flights and their table: trials, results, medians and ranges, as CSV and JSON.

A flight is one `Trial`. A flight that fails is a result too and never ends the comparison. The
function that flies a trial is an argument: this module knows no simulator and no link.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import statistics
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from offboard.analysis.workers import run_all
from offboard.documents.plain import plain
from offboard.documents.reading import DocumentError

EQUAL_SHARE = 0.01  # medians that are closer than this share of the best are equal
FIGURES = (
    "rmse_position_m",
    "max_position_m",
    "rmse_truth_m",
    "tilt_agitation_deg",
    "rate_agitation_radps",
    "rmse_course_deg",
    "solve_time_p99_ms",
)


@dataclass(frozen=True, slots=True)
class Trial:
    """One flight of a comparison, and the directory that records it."""

    controller: str
    reference: str
    scenario: str
    seed: int
    directory: Path


@dataclass(frozen=True, slots=True)
class Result:
    """The end of a trial. `sentence` says how it ended; `figures` are those of its score."""

    trial: Trial
    exit_code: int
    sentence: str
    figures: dict[str, float]
    stopped: bool = False  # by the operator

    @property
    def flown(self) -> bool:
        return self.exit_code == 0 and math.isfinite(self.figures.get("rmse_position_m", math.nan))


@dataclass(frozen=True, slots=True)
class Failure:
    """A flight without figures, and why."""

    seed: int
    sentence: str


@dataclass(frozen=True, slots=True)
class Row:
    """All seeds of one controller on one reference in one scenario: median and range.

    `best`: no flight failed, and the median position error is the lowest of its reference and
    scenario, or within the range of that one's flights, or within EQUAL_SHARE of its median.
    """

    controller: str
    reference: str
    scenario: str
    flights: int
    failures: tuple[Failure, ...]
    median: dict[str, float]
    lowest: dict[str, float]
    highest: dict[str, float]
    best: bool = False

    @property
    def failed(self) -> int:
        return len(self.failures)

    @property
    def flown(self) -> int:
        return self.flights - self.failed

    @property
    def why(self) -> str:
        """The reasons of the failures, each once."""
        return "; ".join(dict.fromkeys(failure.sentence for failure in self.failures))


Fly = Callable[[Trial], Result]


def trials(
    controllers: Sequence[str],
    references: Sequence[str],
    scenarios: Sequence[str],
    seeds: Iterable[int],
    directory: Path,
) -> list[Trial]:
    """A trial for every combination. Raises DocumentError where two would share a directory."""
    planned = [
        Trial(
            controller,
            reference,
            scenario,
            seed,
            directory / "-".join((_stem(controller), _stem(reference), _stem(scenario), str(seed))),
        )
        for reference, scenario, controller, seed in itertools.product(
            references, scenarios, controllers, seeds
        )
    ]
    first: dict[Path, Trial] = {}
    for trial in planned:
        other = first.setdefault(trial.directory, trial)
        if other is not trial:
            raise DocumentError(
                f"{_named(other)} and {_named(trial)} would both be recorded in "
                f"{trial.directory}; give each name once and files different names"
            )
    return planned


def _named(trial: Trial) -> str:
    return f"{trial.controller} on {trial.reference} in {trial.scenario}"


def run(
    planned: Sequence[Trial],
    fly: Fly,
    open_worker: Callable[[], AbstractContextManager[Executor]],
    width: int,
    ending: Callable[[], bool],
) -> Iterator[Result]:
    """Fly all trials in `width` workers (`workers.run_all`) and yield each result when it ends. If
    a worker dies, its flight has failed."""
    for trial, result in run_all(planned, fly, open_worker, width, ending):
        if isinstance(result, BaseException):
            result = Result(trial, 4, _why(result), {})
        yield result


def _why(error: BaseException) -> str:
    if isinstance(error, BrokenExecutor):
        return "the process that flew it ended"
    return f"{type(error).__name__}: {error}"


def table(results: Iterable[Result]) -> list[Row]:
    """One row per controller, reference and scenario, the best of each scenario marked."""
    groups: dict[tuple[str, str, str], list[Result]] = {}
    for result in results:
        trial = result.trial
        key = (trial.reference, trial.scenario, trial.controller)
        groups.setdefault(key, []).append(result)
    rows = [_row(key, groups[key]) for key in groups]
    best: dict[tuple[str, str], Row] = {}
    for row in rows:
        cell = (row.reference, row.scenario)
        if not row.failed and (cell not in best or _error(row) < _error(best[cell])):
            best[cell] = row
    return [
        replace(row, best=_equals(row, best.get((row.reference, row.scenario)))) for row in rows
    ]


def _error(row: Row) -> float:
    return row.median["rmse_position_m"]


def _equals(row: Row, best: Row | None) -> bool:
    if best is None or row.failed:
        return False
    bound = max(best.highest["rmse_position_m"], (1.0 + EQUAL_SHARE) * _error(best))
    return _error(row) <= bound


def _row(key: tuple[str, str, str], results: list[Result]) -> Row:
    reference, scenario, controller = key
    columns = {
        name: _finite(result.figures.get(name, math.nan) for result in results if result.flown)
        for name in FIGURES
    }
    return Row(
        controller=controller,
        reference=reference,
        scenario=scenario,
        flights=len(results),
        failures=tuple(
            Failure(result.trial.seed, result.sentence) for result in results if not result.flown
        ),
        median={
            name: statistics.median(values) if values else math.nan
            for name, values in columns.items()
        },
        lowest={name: min(values, default=math.nan) for name, values in columns.items()},
        highest={name: max(values, default=math.nan) for name, values in columns.items()},
    )


def as_json(rows: Sequence[Row]) -> str:
    """The table as JSON; what no flight gave is null."""
    return json.dumps(plain([asdict(row) for row in rows]), indent=2, allow_nan=False) + "\n"


def as_csv(rows: Sequence[Row]) -> str:
    """The table as CSV, one column per figure and statistic."""
    text = io.StringIO()
    writer = csv.writer(text)
    columns = [(name, which) for name in FIGURES for which in ("median", "lowest", "highest")]
    names = ("controller", "reference", "scenario", "flights", "failed", "best", "why")
    writer.writerow([*names, *(f"{name}_{which}" for name, which in columns)])
    for row in rows:
        values = (getattr(row, which)[name] for name, which in columns)
        figures = (f"{value:.6g}" if math.isfinite(value) else "" for value in values)
        writer.writerow([*(getattr(row, name) for name in names), *figures])
    return text.getvalue()


def _stem(name: str) -> str:
    return Path(name).stem


def _finite(values: Iterable[float]) -> list[float]:
    return [value for value in values if math.isfinite(value)]
