"""A whole comparison: flights in parallel with progress, then table, page, CSV and JSON.

What is finished is kept when the run is interrupted, and what is missing is said.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from offboard.analysis.compare import Fly, Result, Trial, as_csv, as_json, run, table, trials
from offboard.analysis.compare_page import page
from offboard.analysis.compare_table import lines, numbered_seeds
from offboard.analysis.interrupts import deaf_to_interrupts
from offboard.analysis.processors import processors
from offboard.flight.log import LogError
from offboard.flight.phases import ExitCode

ORPHANED = 1


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
    """Fly everything, print and write the table; a sentence on what failed or is missing, or "".

    `workers` None: one process per processor; 0: in this process, one flight after the other (a
    vehicle that is there once; it ends when the vehicle or its pilot no longer lets us fly, for
    the next flight would take it back). Writes compare.csv, compare.json and compare.html. Raises
    LogError before the first flight where `directory` cannot be written or holds something, and
    DocumentError where two flights would share one.
    """
    planned = trials(controllers, references, scenarios, seeds, directory)
    _claim(directory)
    results = _with_progress(planned, fly, workers, console)
    rows = table(sorted(results, key=lambda result: planned.index(result.trial)))
    if rows:
        console.print()
        for line in lines(rows, console.width):
            console.print(line, soft_wrap=True)
    missing = _missing(planned, results)
    ended = _ended(results) if missing and workers == 0 else ""
    if ended:
        missing.insert(0, f"{ended}; nothing more was flown")
    for words in missing:
        console.print(words, style="yellow", markup=False, soft_wrap=True)
    (directory / "compare.csv").write_text(as_csv(rows), encoding="utf-8")
    (directory / "compare.json").write_text(as_json(rows), encoding="utf-8")
    (directory / "compare.html").write_text(page(rows, missing), encoding="utf-8")
    console.print(f"written: {directory / 'compare.html'}", markup=False, soft_wrap=True)
    failed = sum(not result.flown for result in results)
    told = [f"{failed} of {len(results)} flights failed; the table says why"] if failed else []
    if missing:
        count = f"{len(planned) - len(results)} of {len(planned)} flights missing"
        told.append(f"{ended or 'interrupted'}: {count}")
    return "; ".join(told)


def _claim(directory: Path) -> None:
    try:
        directory.mkdir(parents=True, exist_ok=True)
        occupied = any(directory.iterdir())
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
    """What was flown until the end, or until the user asked for an end."""
    columns = TextColumn("flying"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    results: list[Result] = []
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("flying", total=len(planned))

        def told() -> None:
            progress.console.print(
                "interrupted: what is in the air still lands; once more: it is left"
            )

        try:
            with _interruptible(told) as ending:
                for result in _flown(planned, fly, workers, ending):
                    if not result.stopped:
                        results.append(result)
                    progress.advance(task)
        except KeyboardInterrupt:
            pass  # the second one
    return results


def _flown(
    planned: Sequence[Trial], fly: Fly, workers: int | None, ending: Callable[[], bool]
) -> Iterator[Result]:
    if workers == 0:
        for trial in planned:
            if ending():
                return
            result = fly(trial)
            yield result
            if result.stopped or _taken(result):  # the flight heard the interruption, not we
                return
    else:
        width = workers or processors()
        yield from run(planned, fly, _worker, width, ending)


def _taken(result: Result) -> bool:
    return result.exit_code in (ExitCode.REFUSED, ExitCode.ABORTED)


def _ended(results: Sequence[Result]) -> str:
    """Which flight on the one vehicle was the last, if it was the reason for that, or ""."""
    if not results or not _taken(results[-1]):
        return ""
    trial, sentence = results[-1].trial, results[-1].sentence
    return f"ended with {trial.controller} on {trial.reference}, seed {trial.seed} ({sentence})"


@contextmanager
def _worker() -> Iterator[ProcessPoolExecutor]:
    """One process. Left in a hurry, it is killed: asked to end it would land first."""
    # spawn: a forked child would share compiled code and threads in unknown states
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(1, mp_context=context, initializer=_settle)
    with deaf_to_interrupts():
        pool.submit(os.getpid)  # starts it
    try:
        yield pool
    except BaseException:
        for child in multiprocessing.active_children():
            child.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _settle() -> None:
    """In a worker: a terminal that closes is not for us, and without our parent we are not."""
    os.setpgrp()
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(ORPHANED)

    threading.Thread(target=follow, daemon=True).start()


@contextmanager
def _interruptible(told: Callable[[], None]) -> Iterator[Callable[[], bool]]:
    """Whether we were asked to end. The second time raises KeyboardInterrupt."""
    asked = 0

    def on_signal(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked += 1
        if asked > 1:
            raise KeyboardInterrupt
        told()

    kinds = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    heard = [kind for kind in kinds if signal.getsignal(kind) is not signal.SIG_IGN]
    before = {kind: signal.signal(kind, on_signal) for kind in heard}
    try:
        yield lambda: asked > 0
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)


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
