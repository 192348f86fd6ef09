"""The HTML page of a comparison: error and excess motion of every law per scenario, and a table."""

from __future__ import annotations

import html
import itertools
from collections.abc import Sequence

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from offboard.analysis.compare import EQUAL_SHARE, FIGURES, Row
from offboard.analysis.compare_table import digits
from offboard.analysis.figure import PALETTE, RED, Figure, coordinates, listed, logarithmic
from offboard.analysis.page import render

PANELS = {  # figure of the score: title of its panel
    "rmse_position_m": "position error<br>RMSE [m]",
    "tilt_agitation_deg": "excess tilt<br>RMS [deg]",
    "rate_agitation_radps": "excess rates<br>RMS [rad/s]",
}
WIDTHS = (0.5, 0.25, 0.25)  # of the panels
BEST = (
    "lowest median position error of the scenario, or no worse than it: the median lies within the "
    f"range of the best law's flights, or within {EQUAL_SHARE:.0%} of its median."
)
CAPTION = (
    "Dot: median; line: range over the seeds. Excess: motion that the reference does not require "
    f"of an ideal vehicle. Filled and bold: {BEST}"
)
NARROWEST_PX = 640
_ROW_PX, _TOP_PX = 18, 120  # _TOP_PX: tool bar, titles and numbers of the axes


def page(rows: Sequence[Row], missing: Sequence[str] = ()) -> str:
    """The page as text.

    Args:
        rows: the comparison, sorted by reference and scenario.
        missing: a line for each group of flights that was not flown.
    """
    return render(
        "analysis/templates/comparison.html",
        title="Controllers side by side",
        references=list(dict.fromkeys(row.reference for row in rows)),
        flights=sum(row.flights for row in rows),
        not_flown=missing,
        figure=_figure(rows),
        figures=FIGURES,
        rows=rows,
        shown=_value,
        best=BEST,
    )


def _figure(rows: Sequence[Row]) -> Figure:
    """Panels side by side; one line per law, grouped under a heading per scenario."""
    lines = _lines(rows)
    figure = make_subplots(
        cols=len(PANELS), shared_yaxes=True, column_widths=WIDTHS, horizontal_spacing=0.06
    )
    placed = [(row, place) for place, row in enumerate(lines) if isinstance(row, Row) and row.flown]
    laws = list(dict.fromkeys(row.controller for row in rows))
    for law, colour in zip(laws, itertools.cycle(PALETTE), strict=False):
        own = [(row, place) for row, place in placed if row.controller == law]
        for column, name in enumerate(PANELS, 1):
            figure.add_trace(_dots(own, name, colour), row=1, col=column)
    for column, (name, title) in enumerate(PANELS.items(), 1):
        ends = [end for row in rows for end in (row.lowest[name], row.highest[name])]
        figure.update_xaxes(logarithmic(ends), side="top", title_text=title, col=column)
    headed = [(_label(line), isinstance(line, str)) for line in lines]
    listed(figure, headed, _ROW_PX, _TOP_PX)
    return Figure("Position error and excess motion", figure, CAPTION, NARROWEST_PX)


def _lines(rows: Sequence[Row]) -> list[Row | str]:
    """The rows, with a heading (scenario, and reference if there are several) above each block."""
    several = len({row.reference for row in rows}) > 1
    lines: list[Row | str] = []
    for (reference, scenario), block in itertools.groupby(
        rows, lambda row: (row.reference, row.scenario)
    ):
        lines += [f"{scenario}, {reference}" if several else scenario, *block]
    return lines


def _label(line: Row | str) -> str:
    if isinstance(line, str):
        return f"<b>{html.escape(line)}</b>"
    name = html.escape(line.controller)
    if line.failed:
        failed = f"{line.failed} of {line.flights} failed"
        name += f'  <span style="color: {RED}">{failed}</span>'
    return f"<b>{name}</b>" if line.best else name


def _dots(own: Sequence[tuple[Row, int]], name: str, colour: str) -> go.Scatter:
    """Median and range of one law in one panel."""
    rows = [row for row, _ in own]
    return go.Scatter(
        mode="markers", x=coordinates([row.median[name] for row in rows]),
        y=[place for _, place in own], hoverinfo="text",
        text=[
            html.escape(f"{row.controller}, {row.scenario}, {row.reference}: {_value(row, name)}")
            for row in rows
        ],
        marker={
            "color": colour, "size": 9, "line": {"color": colour, "width": 2},
            "symbol": ["circle" if row.best else "circle-open" for row in rows],
        },
        error_x={
            "type": "data", "symmetric": False, "thickness": 1.5, "width": 3, "color": colour,
            "array": coordinates([row.highest[name] - row.median[name] for row in rows]),
            "arrayminus": coordinates([row.median[name] - row.lowest[name] for row in rows]),
        },
    )  # fmt: skip


def _value(row: Row, name: str) -> str:
    middle, low, high = (digits(ends[name]) for ends in (row.median, row.lowest, row.highest))
    return middle if low == high else f"{middle} [{low}–{high}]"
