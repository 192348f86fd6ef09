"""The run behind `offboard paper`: jobs to processes, finished pieces to disk, a page at the end.

Every table and figure is written as soon as its flights are in, so that an interrupted run keeps
what it has; the page is made of what there is and says what is missing.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Generator, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from offboard.analysis.figure import Figure
from offboard.analysis.workers import interrupts_deferred, processors
from offboard.control.swarm import warm_up
from offboard.paper.study.options import PaperError, PaperOptions, check
from offboard.paper.study.page import facts_json, page
from offboard.paper.study.plan import Job, Key, Piece, Plan
from offboard.paper.study.table import Table

PAGE = "paper.html"
_INTERRUPTED = "interrupted before it was finished"
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(slots=True)
class Outcome:
    """What came of a run. `missing`: label -> why, for every piece asked for and not there."""

    page: Path
    finished: list[str] = field(default_factory=list)
    missing: dict[str, str] = field(default_factory=dict)
    interrupted: bool = False


def reproduce(options: PaperOptions, console: Console | None = None) -> Outcome:
    """Compute, write and show everything `options` ask for.

    Raises PaperError (one sentence) for bad options or an output that cannot be written. An
    interrupt (KeyboardInterrupt) is not raised: the outcome says so.
    """
    check(options)
    plan = Plan(options)
    desk = _Desk(options, plan)
    progress = Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        console=console or Console(stderr=True),
    )  # fmt: skip
    interrupted = False
    try:
        with progress, closing(_results(plan, options.workers)) as results:
            bar = progress.add_task("paper", total=len(plan.jobs))
            desk.write_ready()
            for key, result in results:
                desk.receive(key, result)
                progress.advance(bar)
                progress.update(bar, description=desk.last_written or "paper")
    except KeyboardInterrupt:
        interrupted = True
    except OSError as error:
        raise PaperError(f"{options.out} cannot be written: {error.strerror or error}") from None
    return desk.close(interrupted)


class _Desk:
    """Collects results, writes each piece once all it needs is there."""

    def __init__(self, options: PaperOptions, plan: Plan) -> None:
        self._options = options
        self._waiting = list(plan.pieces)
        self._order = [piece.label for piece in plan.pieces]
        self._results: dict[Key, Any] = {}
        self._failed: dict[Key, str] = {}
        self._made: dict[str, Table | Figure] = {}
        self.last_written = ""

    def receive(self, key: Key, result: Any) -> None:
        if isinstance(result, _Failure):
            self._failed[key] = result.reason
        else:
            self._results[key] = result
            self.write_ready()

    def write_ready(self) -> None:
        ready = [piece for piece in self._waiting if all(k in self._results for k in piece.needs)]
        for piece in ready:
            self._waiting.remove(piece)
            made = piece.make(self._results)
            self._write(piece, made)
            self._made[piece.label] = made
            self.last_written = piece.label

    def close(self, interrupted: bool) -> Outcome:
        missing = {piece.label: self._why(piece) for piece in self._waiting}
        facts = _facts(self._options)
        path = self._options.out / PAGE
        path.write_text(page(self._made, missing, facts), encoding="utf-8")
        (self._options.out / "run.json").write_text(facts_json(facts, missing), encoding="utf-8")
        finished = [label for label in self._order if label in self._made]
        return Outcome(path, finished, missing, interrupted)

    def _why(self, piece: Piece) -> str:
        reasons = [self._failed[key] for key in piece.needs if key in self._failed]
        return reasons[0] if reasons else _INTERRUPTED

    def _write(self, piece: Piece, made: Table | Figure) -> None:
        stem = self._options.out / f"{piece.kind}_{piece.name}"
        stem.with_suffix(".json").write_text(made.to_json(), encoding="utf-8")
        if isinstance(made, Table):
            stem.with_suffix(".csv").write_text(made.to_csv(), encoding="utf-8")


@dataclass(frozen=True, slots=True)
class _Failure:
    reason: str


def _results(plan: Plan, workers: int | None) -> Generator[tuple[Key, Any]]:
    """(key, result) as they come; a job that fails gives a `_Failure`."""
    count = min(workers or processors(), len(plan.jobs))
    if count <= 1:
        for key, (function, arguments) in plan.jobs.items():
            yield key, _guarded(function, *arguments)
        return
    with _pool(count) as pool:
        yield from _from_pool(pool, plan.jobs)


def _from_pool(pool: Executor, jobs: dict[Key, Job]) -> Iterator[tuple[Key, Any]]:
    with interrupts_deferred():  # the processes start here, and stay so
        futures: dict[Future[Any], Key] = {
            pool.submit(_guarded, function, *arguments): key
            for key, (function, arguments) in jobs.items()
        }
    for future in as_completed(futures):
        try:
            yield futures[future], future.result()
        except BrokenProcessPool:
            yield futures[future], _Failure("its process ended unexpectedly")


@contextmanager
def _pool(count: int) -> Iterator[ProcessPoolExecutor]:
    """Fresh processes (spawned, so the same on every system), one thread each; on the way out by
    an interrupt what has not begun is dropped."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))  # inherited; read when NumPy is imported
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start_worker)
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _start_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    warm_up()


def _guarded(function: Any, *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except Exception as error:  # a piece fails alone, and the page says so
        return _Failure(f"{type(error).__name__}: {error}")


def _facts(options: PaperOptions) -> list[tuple[str, str]]:
    diagonal = options.first_settings.fitness
    return [
        ("pso-offboard", _version()),
        ("seeds per row", str(options.seed_count)),
        ("quick", "yes" if options.quick else "no"),
        ("diag Q of the first configuration", ", ".join(f"{weight:g}" for weight in diagonal)),
    ]


def _version() -> str:
    try:
        return metadata.version("pso-offboard")
    except metadata.PackageNotFoundError:
        return "not installed"
