"""A whole comparison: flights in parallel with progress, then table, page, CSV and JSON.

What is finished is kept when the run is interrupted.
"""

from __future__ import annotations

import math
import multiprocessing
import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from offboard.analysis.compare import (
    Fly,
    Result,
    Row,
    Trial,
    as_csv,
    as_json,
    run,
    table,
    trials,
)
from offboard.analysis.compare_page import page

COLUMNS = {
    "rmse_position_m": "RMSE [m]",
    "max_position_m": "max [m]",
    "tilt_agitation_deg": "tilt about it [deg]",
    "rate_agitation_radps": "rates about it [rad/s]",
    "solve_time_p99_ms": "solve p99 [ms]",
}


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
) -> int:
    """Fly everything, print and write the table; return how many flights failed.

    `workers` None: one process per processor; 0: in this process, one flight after the other (a
    vehicle that is there once). Writes compare.csv, compare.json and compare.html.
    """
    planned = trials(controllers, references, scenarios, seeds, directory)
    results: list[Result] = []
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("flying", total=len(planned))
        try:
            for result in _flown(planned, fly, workers):
                results.append(result)
                progress.advance(task)
        except KeyboardInterrupt:
            console.print(f"interrupted after {len(results)} of {len(planned)} flights")
    rows = table(sorted(results, key=lambda result: planned.index(result.trial)))
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "compare.csv").write_text(as_csv(rows), encoding="utf-8")
    (directory / "compare.json").write_text(as_json(rows), encoding="utf-8")
    (directory / "compare.html").write_text(page(rows), encoding="utf-8")
    console.print(_shown(rows))
    console.print(f"written: {directory / 'compare.html'}", markup=False, soft_wrap=True)
    return len(planned) - sum(result.flown for result in results)


def _flown(planned: Sequence[Trial], fly: Fly, workers: int | None) -> Iterator[Result]:
    if workers == 0:
        yield from map(fly, planned)
        return
    # spawn: a forked child would share compiled code and threads in unknown states
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers or os.cpu_count(), mp_context=context) as pool:
        yield from run(planned, fly, pool)


def _shown(rows: Sequence[Row]) -> Table:
    shown = Table(box=None, pad_edge=False)
    for name in ("reference", "scenario", "controller"):
        shown.add_column(name)
    shown.add_column("flights", justify="right")
    for title in COLUMNS.values():
        shown.add_column(title, justify="right")
    for row in rows:
        names = (row.reference, row.scenario, row.controller)
        flights = f"{row.flights - row.failed}/{row.flights}"
        cells = [_cell(row, name) for name in COLUMNS]
        if row.failed == row.flights:
            cells[0] = row.why
        shown.add_row(*names, flights, *cells, style="bold" if row.best else None)
    return shown


def _cell(row: Row, name: str) -> str:
    middle, low, high = row.median[name], row.lowest[name], row.highest[name]
    if math.isnan(middle):
        return ""
    return f"{middle:.3g}" if low == high else f"{middle:.3g} [{low:.3g}-{high:.3g}]"
