"""A whole comparison: flights in parallel with progress, then table, page, CSV and JSON.

An interrupted comparison keeps the flights that have ended and names those that are missing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)

from offboard.analysis.compare import Fly, Result, Row, Trial, as_csv, as_json, run, table, trials
from offboard.analysis.compare_page import page
from offboard.analysis.compare_table import digits, numbered_seeds, show
from offboard.analysis.workers import open_worker, processors
from offboard.flight.phases import ExitCode
from offboard.io.log import LogError
from offboard.io.stop import StopRequests

LANDING = "interrupted: flights in the air are landed; interrupt again to exit at once"


def compare_all(
    fly: Fly,
    *,
    controllers: Sequence[str],
    references: Sequence[str],
    scenarios: Sequence[str],
    seeds: Iterable[int],
    directory: Path,
    workers: int | None,
    console: Console,
) -> str:
    """Fly every combination, print and write the table.

    `fly` flies one trial. `workers` is the number of processes, None for one per processor. With 0
    the flights follow each other in this process, for a single vehicle: after a flight that the
    vehicle refused or its pilot ended, nothing more is flown. Writes compare.csv, compare.json and
    compare.html to `directory`.

    Returns a sentence on what failed or is missing, empty if nothing is. Raises, before the first
    flight, LogError where `directory` cannot be written or is not empty, and DocumentError where
    two flights would share a directory.
    """
    planned = trials(controllers, references, scenarios, seeds, directory)
    _claim(directory)
    results = _with_progress(planned, fly, workers, console)
    rows = table(sorted(results, key=lambda result: planned.index(result.trial)))
    if rows:
        console.print()
        show(console, rows)
    missing = _missing(planned, results)
    ended = _ended(results) if missing and workers == 0 else ""
    if ended:
        missing.insert(0, f"{ended}; nothing more was flown")
    for words in missing:
        console.print(words, style="yellow", markup=False)
    unwritten = _written(directory, rows, missing)
    if not unwritten:
        console.print(f"written: {directory / 'compare.html'}", markup=False, soft_wrap=True)
    failed = sum(not result.flown for result in results)
    problems = [f"{failed} of {len(results)} flights failed; the table says why"] if failed else []
    if missing:
        count = f"{len(planned) - len(results)} of {len(planned)} flights missing"
        problems.append(f"{ended or 'interrupted'}: {count}")
    return "; ".join([*problems, *unwritten])


def _written(directory: Path, rows: Sequence[Row], missing: Sequence[str]) -> list[str]:
    """Write the table and the page; a sentence about the first file that cannot be written."""
    documents = {"csv": as_csv(rows), "json": as_json(rows), "html": page(rows, missing)}
    for suffix, text in documents.items():
        path = directory / f"compare.{suffix}"
        try:
            path.write_text(text, encoding="utf-8")
        except OSError as error:
            return [f"{path} cannot be written ({error.strerror})"]
    return []


def _claim(directory: Path) -> None:
    try:
        directory.mkdir(parents=True, exist_ok=True)
        occupied = any(directory.iterdir())
        if not occupied:
            (directory / "compare.csv").touch()
    except OSError as error:
        raise LogError(
            f"the comparison cannot be recorded in {directory}: {error.strerror}; "
            "choose a directory that can be written with --out"
        ) from None
    if occupied:
        raise LogError(f"{directory} is not empty; choose another directory with --out")


def _with_progress(
    planned: Sequence[Trial], fly: Fly, workers: int | None, console: Console
) -> list[Result]:
    """The flights that ended before an interrupt. On a terminal a bar moves, else a line is printed
    for each flight."""
    width = 1 if workers == 0 else min(workers or processors(), len(planned))
    plan = f"{len(planned)} flights, {width} at a time"
    columns = (
        SpinnerColumn(), TextColumn("{task.description}"), BarColumn(bar_width=20),
        MofNCompleteColumn(), TimeElapsedColumn(),
    )  # fmt: skip
    live = console.is_terminal
    if not live:
        console.print(plan)
    results: list[Result] = []
    with Progress(*columns, console=console, transient=True, disable=not live) as progress:
        task = progress.add_task(plan, total=len(planned))
        announced = False

        def ending() -> bool:
            nonlocal announced
            if stops.requested and not announced:
                announced = True
                progress.console.print(LANDING)
            return stops.requested

        with suppress(KeyboardInterrupt), StopRequests() as stops:
            for result in _flown(planned, fly, 0 if workers == 0 else width, ending):
                progress.advance(task)
                if not result.stopped:
                    results.append(result)
                    if not live:
                        console.print(_line(result, len(results)), markup=False, soft_wrap=True)
    return results


def _line(result: Result, number: int) -> str:
    trial = result.trial
    end = f"{digits(result.figures['rmse_position_m'])} m" if result.flown else result.sentence
    return f"{number:4}  {trial.directory.name}: {end}"


def _flown(
    planned: Sequence[Trial], fly: Fly, workers: int, ending: Callable[[], bool]
) -> Iterator[Result]:
    if workers:
        yield from run(planned, fly, open_worker, workers, ending)
        return
    for trial in planned:
        if ending():
            return
        result = fly(trial)
        yield result
        if result.stopped or _taken(result):  # the flight received the interrupt, not this loop
            return


def _taken(result: Result) -> bool:
    return result.exit_code in (ExitCode.REFUSED, ExitCode.ABORTED)


def _ended(results: Sequence[Result]) -> str:
    """Why the last flight ended the comparison, empty if it did not."""
    if not results or not _taken(results[-1]):
        return ""
    trial, sentence = results[-1].trial, results[-1].sentence
    return f"ended with {trial.controller} on {trial.reference}, seed {trial.seed} ({sentence})"


def _missing(planned: Sequence[Trial], results: Sequence[Result]) -> list[str]:
    """A line for each reference and scenario with flights that were not flown."""
    finished = {result.trial for result in results}
    cells: dict[tuple[str, str], dict[str, list[int]]] = {}
    for trial in planned:
        if trial not in finished:
            laws = cells.setdefault((trial.reference, trial.scenario), {})
            laws.setdefault(trial.controller, []).append(trial.seed)
    return [
        f"not flown: {reference}, {scenario}: "
        + "; ".join(f"{law} {numbered_seeds(seeds)}" for law, seeds in laws.items())
        for (reference, scenario), laws in cells.items()
    ]
