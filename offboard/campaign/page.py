"""The page of a campaign or a comparison: success, figures per scenario, a table, worst flights."""

from __future__ import annotations

import html
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from offboard.analysis.figure import PALETTE, RED, Figure, coordinates, listed, logarithmic
from offboard.analysis.page import render
from offboard.campaign.statistics import BEST, ERROR, Group, digits
from offboard.campaign.table import Row

WORST_SHOWN = 20
NARROWEST_PX = 960
_ROW_PX, _TOP_PX = 22, 120  # _TOP_PX: tool bar, titles and numbers of the axes


@dataclass(frozen=True, slots=True)
class Contents:
    """What a page shows: `panels` of the figure with their titles, `figures` of the table, what the
    `ends` of a range are; `boxes`: quartiles and single flights outside, else median and range."""

    title: str
    panels: Mapping[str, str]
    figures: tuple[str, ...]
    ends: str
    caption: str
    boxes: bool = False


ERROR_TITLE = "position error<br>RMSE [m]"
CAMPAIGN = Contents(
    "Campaign",
    {"success": "success rate", ERROR: ERROR_TITLE, "margin": "margin"},
    (ERROR, "max_position_m", "margin"),
    "5 %–95 %",
    "Success: completed, with every requirement met; line: 95 % interval (Wilson). Boxes: "
    "quartiles over seeds and draws; dots: single flights outside. Margin: the least distance to "
    "a limit (promises), as a share of it; 0 at a limit, -1 not completed, -2 not flown.",
    boxes=True,
)
COMPARISON = Contents(
    "Comparison of controllers",
    {
        ERROR: ERROR_TITLE,
        "tilt_agitation_deg": "excess tilt<br>RMS [deg]",
        "rate_agitation_radps": "excess rates<br>RMS [rad/s]",
    },
    (
        ERROR, "max_position_m", "rmse_truth_m", "tilt_agitation_deg", "rate_agitation_radps",
        "rmse_course_deg", "solve_time_p99_ms",
    ),
    "lowest–highest",
    "Dot: median; line: range over the seeds. Excess: motion that the reference does not require "
    "of an ideal vehicle. Filled and bold: the best.",
)  # fmt: skip


def page(
    groups: Sequence[Group],
    contents: Contents,
    missing: Sequence[str] = (),
    kept: Mapping[str, Mapping[str, str]] | None = None,
) -> str:
    """The page as text. `missing`: what is not flown. `kept`: of a campaign, whose worst flights
    are listed: files of kept flights, title to path, by case."""
    rows = [row for group in groups for row in group.rows]
    worst = sorted(rows, key=lambda row: row.severity)[:WORST_SHOWN]
    return render(
        "campaign/templates/campaign.html",
        title=contents.title,
        flights=len(rows),
        successes=sum(not row.failed for row in rows),
        missing_flights=missing,
        figure=_figure(groups, contents) if rows else None,
        contents=contents,
        groups=groups,
        best=BEST if any(group.best for group in groups) else "",
        worst=worst if kept is not None else (),
        kept=kept,
        described=described,
        number=digits,
        percent=lambda share: f"{100 * share:.1f} %",
    )


def described(row: Row) -> str:
    """What a flight was: names, values, seed."""
    case = row.case
    names = (
        case.controller, case.reference, case.scenario, case.vehicle, case.sim_vehicle,
        case.firmware,
    )  # fmt: skip
    words = [name for name in names if name] + [f"{key}={value}" for key, value in case.values]
    return ", ".join([*words, f"seed {case.seed}"])


def _figure(groups: Sequence[Group], contents: Contents) -> Figure:
    """Panels side by side, one line per group, a heading above each scenario."""
    lines: list[Group | str] = []
    for scenario, block in itertools.groupby(groups, lambda group: group.scenario):
        lines += [scenario, *block]
    figure = make_subplots(
        cols=len(contents.panels), shared_yaxes=True, horizontal_spacing=0.07,
        column_widths=[2 if name == ERROR else 1 for name in contents.panels],
    )  # fmt: skip
    placed = [(at, line) for at, line in enumerate(lines) if isinstance(line, Group)]
    names = list(dict.fromkeys(group.name for group in groups))
    for column, (name, title) in enumerate(contents.panels.items(), 1):
        draw = _box if contents.boxes and name != "success" else _dot
        for at, group in placed:
            colour = PALETTE[names.index(group.name) % len(PALETTE)]
            figure.add_trace(draw(at, group, name, colour), row=1, col=column)
        figure.update_xaxes(_axis(groups, name), title_text=title, side="top", row=1, col=column)
    headed = [(_label(line), isinstance(line, str)) for line in lines]
    listed(figure, headed, _ROW_PX, _TOP_PX)
    return Figure("Side by side", figure, contents.caption, NARROWEST_PX)


def _label(line: Group | str) -> str:
    if isinstance(line, str):
        return f"<b>{html.escape(line)}</b>"
    name = html.escape(line.name if len(line.name) <= 40 else f"{line.name[:37]}...")
    if line.failed:
        name += f'  <span style="color: {RED}">{line.failed} of {line.flights} failed</span>'
    return f"<b>{name}</b>" if line.best else name


def _axis(groups: Sequence[Group], name: str) -> dict[str, Any]:
    """The axis of a panel; logarithmic for a figure of the score."""
    if name == "success":
        return {"range": [-0.03, 1.03], "tickformat": ".0%"}
    if name == "margin":
        return {}
    return logarithmic([value for group in groups for value in group.values(name)])


def _dot(at: int, group: Group, name: str, colour: str) -> go.Scatter:
    """Success rate or median, with its interval or range."""
    low, middle, high = group.spread(name)
    value = f"{group.successes} of {group.flights}" if name == "success" else group.shown(name)
    text = f"{group.name}, {group.scenario}: {value}"
    return go.Scatter(
        mode="markers", x=coordinates([middle]), y=[at], hoverinfo="text", text=html.escape(text),
        marker={
            "color": colour, "size": 9, "line": {"color": colour, "width": 2},
            "symbol": "circle" if group.best or name == "success" else "circle-open",
        },
        error_x={
            "type": "data", "symmetric": False, "thickness": 1.5, "width": 3, "color": colour,
            "array": coordinates([high - middle]), "arrayminus": coordinates([middle - low]),
        },
    )  # fmt: skip


def _box(at: int, group: Group, name: str, colour: str) -> go.Box:
    """Quartiles, and single flights outside."""
    return go.Box(
        x=coordinates(group.values(name)), y0=at, orientation="h", width=0.6, name=group.name,
        line={"color": colour, "width": 1.4}, marker={"color": colour, "size": 3},
        hoverinfo="x", boxpoints="outliers",
    )  # fmt: skip
