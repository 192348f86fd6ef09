"""The table of a comparison for a terminal: controllers below each other, a block per scenario."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from offboard.campaign.statistics import BEST, ERROR, Group, digits

# figure of the score, its title
COLUMNS = (
    (ERROR, "RMSE\n[m]"),
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
    BEST,
)


def show(console: Console, groups: Sequence[Group]) -> None:
    """Print the table, its legend and, for every failed flight, the reason."""
    columns = COLUMNS if console.width >= DEFAULT_WIDTH else COLUMNS[:NARROW]
    table = Table(box=None, pad_edge=False)
    separator = " " if console.width > DEFAULT_WIDTH else "\n"
    table.add_column("controller", overflow="fold")
    for _, title in columns:
        table.add_column(Text(title), justify="right", no_wrap=True)
    for block, members in itertools.groupby(groups, _block):
        table.add_row(Text(f"\n{block}", "bold"))
        for group in members:
            mark, style = ("*", "bold") if group.best else (" ", "" if group.successes else "red")
            cells = _cells(group, separator)[: len(columns)]
            table.add_row(Text(f"{mark} {_name(group)}"), *cells, style=style)
    console.print(table)
    console.print()
    for line in LEGEND:
        console.print(Text(line, "dim"))
    for group in groups:
        for reason in group.reasons:
            seeds = [row.case.seed for row in group.rows if row.failed == reason]
            where = f"{group.case.controller}, {_block(group)}, {numbered_seeds(seeds)}"
            console.print(Text(f"failed: {where}: {reason}", "red"))


def _block(group: Group) -> str:
    return f"{group.case.reference}, {group.scenario}"


def _name(group: Group) -> str:
    part = f" ({group.successes} of {group.flights})" if group.failed else ""
    return f"{group.case.controller}{part}"


def _cells(group: Group, separator: str) -> list[Text]:
    medians = [digits(group.spread(figure)[1]) for figure, _ in COLUMNS[1:]]
    return [Text(cell) for cell in (group.shown(ERROR).replace(" ", separator), *medians)]


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
