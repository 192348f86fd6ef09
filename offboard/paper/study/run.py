"""The run behind `offboard paper`: jobs in parallel, each result written as soon as it is complete.

An interrupted run keeps its finished tables and figures; the page shows them and names the rest.
"""

from __future__ import annotations

import json
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from offboard.analysis.figure import Figure
from offboard.analysis.workers import open_worker, processors, run_all
from offboard.documents.errors import UserError
from offboard.paper.study.options import PaperOptions, check
from offboard.paper.study.page import Table, page
from offboard.paper.study.plan import Job, planned

PAGE = "paper.html"
_INTERRUPTED = "interrupted before it was finished"


@dataclass(slots=True)
class Outcome:
    """The result of a run: the page, the labels of what is on it, and label -> reason for every
    table and figure that is missing."""

    page: Path
    finished: list[str] = field(default_factory=list)
    missing: dict[str, str] = field(default_factory=dict)
    interrupted: bool = False


def reproduce(options: PaperOptions, console: Console | None = None) -> Outcome:
    """Compute and write everything that `options` ask for, with progress on `console` (stderr).

    Writes table_NAME.csv and .json, figure_NAME.json, run.json and paper.html to `options.out`.
    Raises UserError for invalid options or an output that cannot be written. An interrupt
    (KeyboardInterrupt) is not raised: the outcome records it.
    """
    check(options)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    progress = Progress(*columns, TimeElapsedColumn(), console=console or Console(stderr=True))
    collected = _Collected(options)
    interrupted = False
    try:
        with progress, closing(_results(collected.jobs, options.workers)) as results:
            bar = progress.add_task("paper", total=len(collected.jobs))
            collected.write_complete()
            for job, result, reason in results:
                collected.add(job, result, reason)
                progress.update(bar, advance=1, description=collected.last or "paper")
    except KeyboardInterrupt:
        interrupted = True
    except OSError as error:
        raise UserError(f"{options.out} cannot be written: {error.strerror or error}") from None
    return collected.finish(interrupted)


class _Collected:
    """The results so far; writes each table and figure once all its results are there."""

    def __init__(self, options: PaperOptions) -> None:
        self._options = options
        self._pieces = planned(options)
        self.jobs = list(dict.fromkeys(job for each in self._pieces.values() for job in each.jobs))
        self._results: dict[Job, Any] = {}
        self._failed: dict[Job, str] = {}
        self._made: dict[str, Table | Figure] = {}
        self.last = ""  # label of the latest table or figure

    def add(self, job: Job, result: Any, reason: str) -> None:
        """`reason`: why the job failed, or ""."""
        if reason:
            self._failed[job] = reason
        else:
            self._results[job] = result
            self.write_complete()

    def write_complete(self) -> None:
        for label, piece in self._pieces.items():
            if label in self._made or not all(job in self._results for job in piece.jobs):
                continue
            made = self._made[label] = piece.made(self._results)
            stem = self._options.out / label.replace(" ", "_")
            stem.with_suffix(".json").write_text(made.to_json(), encoding="utf-8")
            if isinstance(made, Table):
                stem.with_suffix(".csv").write_text(made.to_csv(), encoding="utf-8")
            self.last = label

    def finish(self, interrupted: bool) -> Outcome:
        missing = {
            label: next((self._failed[j] for j in piece.jobs if j in self._failed), _INTERRUPTED)
            for label, piece in self._pieces.items()
            if label not in self._made
        }
        facts = _facts(self._options)
        path = self._options.out / PAGE
        path.write_text(page(self._made, missing, facts), encoding="utf-8")
        document = json.dumps({"run": facts, "missing": missing}, indent=1) + "\n"
        path.with_name("run.json").write_text(document, encoding="utf-8")
        finished = [label for label in self._pieces if label in self._made]
        return Outcome(path, finished, missing, interrupted)


def _results(jobs: Sequence[Job], workers: int | None) -> Generator[tuple[Job, Any, str]]:
    """(job, result, reason of a failure or "") in the order in which they end."""
    count = min(workers or processors(), len(jobs))
    if count <= 1:
        for job in jobs:
            yield job, *_guarded(job)
        return
    with closing(run_all(jobs, _guarded, open_worker, count, lambda: False)) as results:
        for job, result in results:
            if isinstance(result, BaseException):
                yield job, None, "its process ended unexpectedly"
            else:
                yield job, *result


def _guarded(job: Job) -> tuple[Any, str]:
    try:
        return job.function(*job.arguments), ""
    except Exception as error:  # costs its own tables and figures only; the page gives the reason
        return None, f"{type(error).__name__}: {error}"


def _facts(options: PaperOptions) -> dict[str, str]:
    diagonal = options.first_settings.fitness
    return {
        "pso-offboard": metadata.version("pso-offboard"),
        "seeds per row": str(options.seed_count),
        "quick": "yes" if options.quick else "no",
        "diag Q of the first configuration": ", ".join(f"{weight:g}" for weight in diagonal),
    }
