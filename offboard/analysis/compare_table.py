"""The table of a comparison for a terminal: controllers below each other, a block per scenario."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from offboard.analysis.compare import EQUAL_SHARE, Row

# figure of the score, its title
COLUMNS = (
    ("rmse_position_m", "RMSE\n[m]"),
    ("max_position_m", "maximum\n[m]"),
    ("tilt_agitation_deg", "tilt\n[deg]"),
    ("rate_agitation_radps", "rates\n[rad/s]"),
    ("solve_time_p99_ms", "decision\n[ms]"),
)
DEFAULT_WIDTH = 80  # of a terminal
NARROW = 3  # columns that are shown where it is narrower
LEGEND = (
    "RMSE, maximum: position error, medians of all flights [lowest\N{EN DASH}highest]. "
    "tilt, rates: motion beside the reference's, RMS. decision: 99th percentile of its time.",
    "* best: lowest median RMSE of the block; or a median within the range of the best, or within "
    f"{EQUAL_SHARE:.0%} of its median.",
)


def show(console: Console, rows: Sequence[Row]) -> None:
    """Print the table, its legend and, for every failed flight, the reason."""
    columns = COLUMNS if console.width >= DEFAULT_WIDTH else COLUMNS[:NARROW]
    table = Table(box=None, pad_edge=False)
    separator = " " if console.width > DEFAULT_WIDTH else "\n"
    table.add_column("controller", overflow="fold")
    for _, title in columns:
        table.add_column(Text(title), justify="right", no_wrap=True)
    for block, members in itertools.groupby(rows, lambda row: f"{row.reference}, {row.scenario}"):
        table.add_row(Text(f"\n{block}", "bold"))
        for row in members:
            mark, style = ("*", "bold") if row.best else (" ", "" if row.flown else "red")
            table.add_row(
                Text(f"{mark} {_name(row)}"), *_cells(row, separator)[: len(columns)], style=style
            )
    console.print(table)
    console.print()
    for line in LEGEND:
        console.print(Text(line, "dim"))
    for row in rows:
        for reason in dict.fromkeys(failure.sentence for failure in row.failures):
            seeds = [failure.seed for failure in row.failures if failure.sentence == reason]
            where = f"{row.controller}, {row.reference}, {row.scenario}, {numbered_seeds(seeds)}"
            console.print(Text(f"failed: {where}: {reason}", "red"))


def _name(row: Row) -> str:
    part = f" ({row.flown} of {row.flights})" if row.failed else ""
    return row.controller + part


def _cells(row: Row, separator: str) -> list[Text]:
    if not row.flown:
        return []
    cells = [digits(row.median[figure]) for figure, _ in COLUMNS]
    low, high = (digits(ends["rmse_position_m"]) for ends in (row.lowest, row.highest))
    if low != high:
        cells[0] += f"{separator}[{low}\N{EN DASH}{high}]"
    return [Text(cell) for cell in cells]


def digits(value: float) -> str:
    """Three significant digits, empty for what is not finite."""
    if not math.isfinite(value):
        return ""
    value = float(f"{value:.3g}")
    size = math.floor(math.log10(abs(value))) if value else 0
    return f"{value:.2e}" if size < -4 else f"{value:.{max(0, 2 - size)}f}"


def numbered_seeds(seeds: Sequence[int]) -> str:
    """`seed 3`, `seeds 1-3, 5`."""
    runs: list[list[int]] = []
    for seed in sorted(seeds):
        if runs and seed == runs[-1][-1] + 1:
            runs[-1].append(seed)
        else:
            runs.append([seed])
    text = ", ".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs)
    return f"seed{'s' if len(seeds) > 1 else ''} {text}"
