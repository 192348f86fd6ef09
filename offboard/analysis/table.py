"""A score for the terminal: what happened, then the figures. Only presentation."""

from __future__ import annotations

import math

from rich.console import Console
from rich.table import Table

from offboard.analysis.history import Event, History
from offboard.analysis.score import FIGURES, Score

SECTIONS = {
    "rmse_position_m": "tracking",
    "mu_e": "the paper's fitness",
    "tracked_s": "activity",
    "setpoint_hz": "stream",
    "solve_time_p50_ms": "decisions",
    "position_hz": "telemetry",
}


def show(console: Console, score: Score, history: History) -> None:
    """Print phases, modes, what the vehicle said, and every figure that the log holds."""
    told = {"phase": history.phases, "mode": history.modes, "the vehicle said": history.said}
    for title, happenings in told.items():
        if happenings:
            console.print(_story(title, happenings))
    if all(math.isnan(value) for value in score.figures().values()):
        console.print("nothing was flown that could be scored")
        return
    table = Table(title="score", title_justify="left", box=None, pad_edge=False)
    table.add_column("figure", style="bold")
    table.add_column("value", justify="right")
    table.add_column("unit")
    table.add_column("meaning", style="dim")
    for name, value in score.figures().items():
        if name in SECTIONS:
            table.add_section()
        if not math.isnan(value):
            table.add_row(name, f"{value:.4g}", FIGURES[name]["unit"], FIGURES[name]["meaning"])
    console.print(table)


def _story(title: str, happenings: tuple[Event, ...]) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("t [s]", justify="right")
    table.add_column(title)
    for happening in happenings:
        stamp = "" if math.isnan(happening.time_s) else f"{happening.time_s:.2f}"
        table.add_row(stamp, happening.what)
    return table
