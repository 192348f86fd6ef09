"""Controllers side by side: every combination flown, scored, and put into one table.

A flight is one `Trial`; it fails as a row of the table, never as a crash. Each is flown by the
function that it is handed, so that this module knows no simulator and no socket.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import statistics
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path

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
    """One flight to be flown, and where it is recorded."""

    controller: str
    reference: str
    scenario: str
    seed: int
    directory: Path


@dataclass(frozen=True, slots=True)
class Result:
    """What became of a trial: `figures` of its score (NaN where absent), or why there is none."""

    trial: Trial
    exit_code: int
    sentence: str
    figures: dict[str, float]

    @property
    def flown(self) -> bool:
        return self.exit_code == 0 and math.isfinite(self.figures.get("rmse_position_m", math.nan))


@dataclass(frozen=True, slots=True)
class Row:
    """All seeds of one controller on one reference in one scenario: median and range."""

    controller: str
    reference: str
    scenario: str
    flights: int
    failed: int
    median: dict[str, float]
    lowest: dict[str, float]
    highest: dict[str, float]
    best: bool
    why: str


Fly = Callable[[Trial], Result]


def trials(
    controllers: Sequence[str],
    references: Sequence[str],
    scenarios: Sequence[str],
    seeds: Iterable[int],
    directory: Path,
) -> list[Trial]:
    """Every combination, a directory for each."""
    return [
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


def run(planned: Sequence[Trial], fly: Fly, pool: Executor) -> Iterator[Result]:
    """Fly all in `pool`, yielding each result as it ends. A worker that dies is a failed row."""
    waiting: dict[Future[Result], Trial] = {pool.submit(fly, trial): trial for trial in planned}
    for done in as_completed(waiting):
        error = done.exception()
        if error is None:
            yield done.result()
        else:
            yield Result(waiting[done], 4, f"{type(error).__name__}: {error}", {})


def table(results: Iterable[Result]) -> list[Row]:
    """One row per controller, reference and scenario; the lowest median error of each reference
    and scenario, with no flight failed, is marked best."""
    groups: dict[tuple[str, str, str], list[Result]] = {}
    for result in results:
        trial = result.trial
        key = (trial.reference, trial.scenario, trial.controller)
        groups.setdefault(key, []).append(result)
    rows = [_row(key, groups[key]) for key in groups]
    best: dict[tuple[str, str], float] = {}
    for row in rows:
        if not row.failed:
            cell = (row.reference, row.scenario)
            error = row.median["rmse_position_m"]
            best[cell] = min(error, best.get(cell, math.inf))
    return [
        replace(
            row,
            best=not row.failed
            and row.median["rmse_position_m"] == best[row.reference, row.scenario],
        )
        for row in rows
    ]


def _row(key: tuple[str, str, str], results: list[Result]) -> Row:
    reference, scenario, controller = key
    flown = [result for result in results if result.flown]
    columns = {
        name: _finite(result.figures.get(name, math.nan) for result in flown) for name in FIGURES
    }
    failed = [result.sentence for result in results if not result.flown]
    return Row(
        controller=controller,
        reference=reference,
        scenario=scenario,
        flights=len(results),
        failed=len(failed),
        median={
            name: statistics.median(values) if values else math.nan
            for name, values in columns.items()
        },
        lowest={name: min(values, default=math.nan) for name, values in columns.items()},
        highest={name: max(values, default=math.nan) for name, values in columns.items()},
        best=False,
        why=failed[0] if failed else "",
    )


def as_json(rows: Sequence[Row]) -> str:
    """The table as JSON; what no flight gave is null."""
    return json.dumps([_plain(asdict(row)) for row in rows], indent=2, allow_nan=False) + "\n"


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


def _plain(value: object) -> object:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
