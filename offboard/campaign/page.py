"""The page of a campaign: success, distributions per scenario, worst flights."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from offboard.analysis.compare_table import digits
from offboard.analysis.figure import BLUE, PALETTE, Figure, coordinates, listed, logarithmic
from offboard.analysis.page import render
from offboard.campaign.statistics import Group
from offboard.campaign.table import Row

WORST_SHOWN = 20
PANELS = {
    "success": "success rate",
    "rmse_position_m": "position error<br>RMSE [m]",
    "margin": "margin",
}
CAPTION = (
    "Success: completed, with every requirement met; line: 95 % interval (Wilson). Boxes: "
    "quartiles over seeds and draws; dots: single flights outside. Margin: the least distance to "
    "a limit (promises), as a share of it; 0 at a limit, -1 not completed, -2 not flown."
)
NARROWEST_PX = 800
_ROW_PX, _TOP_PX = 26, 110


def page(
    groups: Sequence[Group],
    missing: Sequence[str],
    kept: Mapping[str, Mapping[str, str]],
) -> str:
    """The page as text. `missing`: what is not flown yet. `kept`: files of kept flights, title to
    path, by case."""
    rows = [row for group in groups for row in group.rows]
    worst = sorted(rows, key=lambda row: row.severity)[:WORST_SHOWN]
    return render(
        "campaign/templates/campaign.html",
        title="Campaign",
        flights=len(rows),
        successes=sum(not row.failed for row in rows),
        missing_flights=missing,
        figure=_figure(groups) if rows else None,
        groups=groups,
        worst=worst,
        kept=kept,
        described=described,
        number=digits,
        percent=lambda share: f"{100 * share:.1f} %",
    )


def described(row: Row) -> str:
    """What a flight was: names, values, seed."""
    case = row.case
    names = (case.controller, case.reference, case.scenario, case.vehicle, case.sim_vehicle)
    words = [name for name in names if name] + [f"{key}={value}" for key, value in case.values]
    return ", ".join([*words, f"seed {case.seed}"])


def _figure(groups: Sequence[Group]) -> Figure:
    """Panels side by side, one line per group, a heading above each scenario."""
    lines: list[Group | str] = []
    for group in groups:
        if not lines or group.scenario != _scenario(lines[-1]):
            lines.append(group.scenario)
        lines.append(group)
    figure = make_subplots(
        cols=len(PANELS), shared_yaxes=True, column_widths=(0.3, 0.4, 0.3), horizontal_spacing=0.07
    )
    placed = [(at, line) for at, line in enumerate(lines) if isinstance(line, Group)]
    figure.add_trace(_success(placed), row=1, col=1)
    names = list(dict.fromkeys(group.name for group in groups))
    for column, name in enumerate(PANELS, 1):
        if name != "success":
            for at, group in placed:
                colour = PALETTE[names.index(group.name) % len(PALETTE)]
                figure.add_trace(_box(at, group, name, colour), row=1, col=column)
        figure.update_xaxes(title_text=PANELS[name], side="top", row=1, col=column)
    figure.update_xaxes(range=[-0.03, 1.03], tickformat=".0%", row=1, col=1)
    errors = [value for group in groups for value in group.values("rmse_position_m")]
    figure.update_xaxes(logarithmic(errors), row=1, col=2)
    headed = [(_label(line), isinstance(line, str)) for line in lines]
    listed(figure, headed, _ROW_PX, _TOP_PX)
    return Figure("Success, error and margin", figure, CAPTION, NARROWEST_PX)


def _scenario(line: Group | str) -> str:
    return line if isinstance(line, str) else line.scenario


def _label(line: Group | str) -> str:
    if isinstance(line, str):
        return f"<b>{html.escape(line)}</b>"
    return html.escape(line.name if len(line.name) <= 40 else f"{line.name[:37]}...")


def _success(placed: Sequence[tuple[int, Group]]) -> go.Scatter:
    rates = [group.successes / group.flights for _, group in placed]
    return go.Scatter(
        mode="markers", x=coordinates(rates), y=[at for at, _ in placed], hoverinfo="text",
        text=[f"{group.successes} of {group.flights}" for _, group in placed],
        marker={"color": BLUE, "size": 9},
        error_x={
            "type": "data", "symmetric": False, "thickness": 1.5, "width": 3, "color": BLUE,
            "array": coordinates([g.high - r for (_, g), r in zip(placed, rates, strict=True)]),
            "arrayminus": coordinates([r - g.low for (_, g), r in zip(placed, rates, strict=True)]),
        },
    )  # fmt: skip


def _box(at: int, group: Group, name: str, colour: str) -> go.Box:
    values = [value for value in group.values(name) if math.isfinite(value)]
    return go.Box(
        x=coordinates(values), y0=at, orientation="h", width=0.6, name=group.name,
        line={"color": colour, "width": 1.4}, marker={"color": colour, "size": 3},
        hoverinfo="x", boxpoints="outliers",
    )  # fmt: skip
