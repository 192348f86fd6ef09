"""The page of a campaign: plots by block, a table, worst flights."""

from __future__ import annotations

import html
import itertools
from collections.abc import Callable, Mapping, Sequence

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from offboard.analysis.page import PALETTE, RED, STYLE, Figure, coordinates, logarithmic, render
from offboard.campaign.table import BEST, CASE_COLUMNS, ERROR, Group, Row, digits

WORST_SHOWN = 20
NARROWEST_PX = 960
_ROW_PX, _TOP_PX = 22, 120  # _TOP_PX: tool bar, titles and numbers of the axes


# metric of the score, the title of its panel
PANELS = {
    ERROR: "position error<br>RMSE [m]",
    "margin": "margin",
    "tilt_agitation_deg": "excess tilt<br>RMS [deg]",
    "rate_agitation_radps": "excess rates<br>RMS [rad/s]",
}
# of the table
TABLE_METRICS = (
    ERROR, "max_position_m", "margin", "rmse_truth_m", "tilt_agitation_deg",
    "rate_agitation_radps", "rmse_heading_deg",
)  # fmt: skip
CAPTION = (
    "Boxes: quartiles over seeds and draws; dots: single flights outside. Margin: the least "
    "distance to a limit (promises), as a share of it; 0 at a limit, -1 not completed, -2 not "
    "flown. Excess: motion that the reference does not require of an ideal vehicle. Bold: the best "
    "of its block."
)


def page(
    groups: Sequence[Group],
    missing: Sequence[str] = (),
    links: Callable[[Row], Mapping[str, str]] = lambda row: {},
) -> str:
    """The page as text. `missing`: what is not flown; `links`: the files of a kept flight by name,
    relative to the page."""
    rows = [row for group in groups for row in group.rows]
    return render(
        "campaign/templates/campaign.html",
        title="Campaign",
        flights=len(rows),
        successes=sum(not row.failed for row in rows),
        missing_flights=missing,
        figure=_figure(groups) if rows else None,
        metrics=TABLE_METRICS,
        groups=groups,
        best=BEST if any(group.best for group in groups) else "",
        worst=sorted(rows, key=lambda row: (row.record.margin, row.case.key))[:WORST_SHOWN],
        links=links,
        described=described,
        number=digits,
        percent=lambda share: f"{100 * share:.1f} %",
    )


def described(row: Row) -> str:
    """What a flight was: names, values, seed."""
    names = [name for column in CASE_COLUMNS if (name := getattr(row.case, column))]
    values = [f"{key}={value}" for key, value in row.case.values]
    return ", ".join([*names, *values, f"seed {row.case.seed}"])


def _figure(groups: Sequence[Group]) -> Figure:
    """Panels side by side, one line per group, a heading above each block."""
    lines: list[Group | str] = []
    for block, members in itertools.groupby(groups, lambda group: group.block):
        lines += [block, *members]
    figure = make_subplots(cols=len(PANELS), shared_yaxes=True, horizontal_spacing=0.05)
    names = list(dict.fromkeys(group.name for group in groups))
    for column, (name, title) in enumerate(PANELS.items(), 1):
        for at, group in enumerate(lines):
            if isinstance(group, Group):
                colour = PALETTE[names.index(group.name) % len(PALETTE)]
                figure.add_trace(_box(at, group, name, colour), row=1, col=column)
        values = [value for group in groups for value in group.values(name)]
        axis = {"nticks": 4} if name == "margin" else logarithmic(values)
        figure.update_xaxes(axis, title_text=title, tickangle=0, side="top", row=1, col=column)
    figure.update_yaxes(
        tickvals=list(range(len(lines))), ticktext=[_label(line) for line in lines],
        range=[len(lines) - 0.3, -0.7], showgrid=False, zeroline=False, fixedrange=True,
        showline=False, ticks="", ticklabelstandoff=8,
    )  # fmt: skip
    figure.update_layout(
        template=STYLE, height=_TOP_PX + _ROW_PX * len(lines) + 10, showlegend=False,
        margin={"t": _TOP_PX, "b": 10},
    )  # fmt: skip
    return Figure("Side by side", figure, CAPTION, NARROWEST_PX)


def _label(line: Group | str) -> str:
    if isinstance(line, str):
        return f"<b>{html.escape(line)}</b>"
    name = html.escape(line.name if len(line.name) <= 40 else f"{line.name[:37]}...")
    if line.failed:
        name += f'  <span style="color: {RED}">{line.failed} of {line.flights} failed</span>'
    return f"<b>{name}</b>" if line.best else name


def _box(at: int, group: Group, name: str, colour: str) -> go.Box:
    """Quartiles, and single flights outside."""
    return go.Box(
        x=coordinates(group.values(name)), y0=at, orientation="h", width=0.6, name=group.name,
        line={"color": colour, "width": 1.4}, marker={"color": colour, "size": 3},
        hoverinfo="x", boxpoints="outliers",
    )  # fmt: skip
