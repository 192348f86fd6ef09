"""The table of a campaign: one row per flight as CSV, and groups of flights for the terminal and
for the page. The page has plots by block, a table, and the worst flights.

The CSV leaves out the metrics that are measured with this computer's clock, so that it is the same,
byte for byte, however the flights were flown. A group consists of the flights of one combination,
which differ only in seed and draw. A block consists of the groups that are compared: they have the
same reference, scenario, vehicles and firmware.
"""

from __future__ import annotations

import csv
import html
import io
import itertools
import json
import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots
from rich.console import Console
from rich.table import Table
from rich.text import Text
from scipy import stats

from offboard.analysis.page import PALETTE, RED, STYLE, Figure, coordinates, logarithmic, render
from offboard.analysis.score import METRICS, Requirement
from offboard.campaign.cases import Case
from offboard.campaign.results import Record

CASE_COLUMNS = ("controller", "reference", "scenario", "vehicle", "sim_vehicle", "firmware")
METRIC_COLUMNS = tuple(name for name, about in METRICS.items() if not about["wall"])
CONFIDENCE = 0.95
ERROR = "rmse_position_m"
EQUAL_SHARE = 0.01  # medians within this share of the best one count as equal
BEST = (
    "* best: lowest median RMSE of its block; or a median within the range of the best, or within "
    f"{EQUAL_SHARE:.0%} of its median."
)
# metric of the score, title of its column in the terminal
SHOWN = (
    (ERROR, "RMSE\n[m]"),
    ("max_position_m", "maximum\n[m]"),
    ("tilt_agitation_deg", "tilt\n[deg]"),
    ("rate_agitation_radps", "rates\n[rad/s]"),
    ("solve_time_p99_ms", "decision\n[ms]"),
)
DEFAULT_WIDTH = 80  # columns of a terminal
LEGEND = (
    "RMSE, maximum: position error, medians of all flights [lowest\N{EN DASH}highest]. "
    "tilt, rates: motion not due to the reference, RMS. decision: 99th percentile of its time.",
    BEST,
)
WORST_SHOWN = 20
NARROWEST_PX = 960
_ROW_PX, _TOP_PX = 22, 120  # _TOP_PX: tool bar, titles and numbers of the axes
# metric of the score -> title of its panel on the page
PANELS = {
    ERROR: "position error<br>RMSE [m]",
    "margin": "margin",
    "tilt_agitation_deg": "excess tilt<br>RMS [deg]",
    "rate_agitation_radps": "excess rates<br>RMS [rad/s]",
}
# columns of the table on the page
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


@dataclass(frozen=True, slots=True)
class Row:
    """A finished flight. `failed` says why the flight is no success; empty if it is one."""

    case: Case
    record: Record
    failed: str


def row_of(case: Case, record: Record, requirements: Sequence[Requirement]) -> Row:
    """Return the row of a finished flight, a success if completed with all requirements met."""
    if not record.completed:
        return Row(case, record, record.sentence)
    metrics = {name: record.figures.get(name, math.nan) for name in METRICS}
    missed = [each.sentence(metrics) for each in requirements if not each.met(metrics)]
    return Row(case, record, "; ".join(missed))


def columns(rows: Sequence[Row]) -> dict[str, list[Any]]:
    """Return the table by columns. A value that a flight does not have is None."""
    values = [dict(row.case.values) for row in rows]
    keys = dict.fromkeys(itertools.chain.from_iterable(values))
    return {
        "case": [row.case.key for row in rows],
        **{name: [getattr(row.case, name) for row in rows] for name in CASE_COLUMNS},
        **{key: [_scalar(own.get(key)) for own in values] for key in keys},
        "seed": [row.case.seed for row in rows],
        "success": [int(not row.failed) for row in rows],
        "exit_code": [row.record.exit_code for row in rows],
        "ended": [row.record.sentence for row in rows],
        "failed": [row.failed for row in rows],
        "margin": [row.record.margin for row in rows],
        "weakest": [row.record.weakest for row in rows],
        **{name: [row.record.figures.get(name) for row in rows] for name in METRIC_COLUMNS},
        "fly_again": [row.case.line for row in rows],
    }


def _scalar(value: Any) -> Any:
    plain = value is None or (isinstance(value, str | int | float) and not isinstance(value, bool))
    return value if plain else json.dumps(value)


def as_csv(table: Mapping[str, Sequence[Any]]) -> str:
    """Return the table as CSV; numbers with all digits."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table)
    writer.writerows(zip(*table.values(), strict=True))
    return text.getvalue()


@dataclass(frozen=True, slots=True)
class Group:
    """Flights of one combination. `name` is the controller and the values that differ, `block` the
    rest of the combination; `best` is explained at `groups`."""

    name: str
    block: str
    rows: tuple[Row, ...]
    best: bool = False

    @property
    def flights(self) -> int:
        return len(self.rows)

    @property
    def successes(self) -> int:
        return sum(not row.failed for row in self.rows)

    @property
    def failed(self) -> int:
        return self.flights - self.successes

    @property
    def interval(self) -> Any:
        """Wilson's score interval of the success rate at CONFIDENCE, with fields `low`, `high`."""
        counted = stats.binomtest(self.successes, self.flights)
        return counted.proportion_ci(CONFIDENCE, method="wilson")

    @property
    def reasons(self) -> dict[str, list[int]]:
        """The reasons why flights failed, each with the seeds of those flights."""
        found: dict[str, list[int]] = {}
        for row in self.rows:
            if row.failed:
                found.setdefault(row.failed, []).append(row.case.seed)
        return found

    def values(self, metric: str) -> list[float]:
        """Return a metric of all completed flights, or `margin` of all flights."""
        if metric == "margin":
            return [row.record.margin for row in self.rows]
        completed = (row.record for row in self.rows if row.record.completed)
        return [r.figures[metric] for r in completed if metric in r.figures]

    def spread(self, metric: str) -> tuple[float, float, float]:
        """Return the lowest, median and highest value of a metric; NaN without values."""
        values = self.values(metric)
        if not values:
            return math.nan, math.nan, math.nan
        return min(values), float(np.median(values)), max(values)

    def shown(self, metric: str) -> str:
        """Return median and range of a metric as text; empty without values."""
        low, middle, high = map(digits, self.spread(metric))
        return middle if low == high else f"{middle} [{low}\N{EN DASH}{high}]"


def groups(rows: Sequence[Row], drawn: frozenset[str] = frozenset()) -> list[Group]:
    """Return the groups in the order of the table, with the best of each block marked. Their names
    contain the values that differ, except those of the keys `drawn` (of a sample).

    Best is a group without failed flights whose median position error is the lowest of the block,
    or within the range of the flights of that group, or within EQUAL_SHARE of its median.
    """
    blocks: dict[str, dict[str, list[Row]]] = {}
    distinct = set(itertools.chain.from_iterable(_values(row.case) for row in rows))
    differ = {key for key, number in Counter(key for key, _ in distinct).items() if number > 1}
    named = _shortened(differ - drawn, lambda key: key.rpartition(".")[2])
    names = {name for row in rows for name in _names(row.case)}
    stems = _shortened(names, lambda name: PurePath(name).stem)
    for row in rows:
        controller, *others = [stems[name] for name in _names(row.case)]
        values = [f"{named[key]}={value}" for key, value in _values(row.case) if key in named]
        own = blocks.setdefault(", ".join(name for name in others if name), {})
        own.setdefault(" ".join((controller, *values)), []).append(row)
    found: list[Group] = []
    for block, members in blocks.items():
        made = [Group(name, block, tuple(rows)) for name, rows in members.items()]
        errors = [_error(group) for group in made]
        median, highest = min(errors)
        bound = max(highest, (1.0 + EQUAL_SHARE) * median)
        found += [
            replace(group, best=math.isfinite(error) and error <= bound)
            for group, (error, _) in zip(made, errors, strict=True)
        ]
    return found


def _error(group: Group) -> tuple[float, float]:
    """Return the median and highest position error; infinite if a flight failed."""
    _, median, highest = group.spread(ERROR)
    return (math.inf, math.inf) if group.failed or math.isnan(median) else (median, highest)


def _names(case: Case) -> tuple[str, ...]:
    """Return the controller, or the configuration without one, and the names of the block."""
    firmware = "" if case.firmware == "px4" else case.firmware
    block = (case.reference, case.scenario, case.vehicle, case.sim_vehicle, firmware)
    return case.controller or case.config, *(name or "" for name in block)


def _shortened(names: Collection[str], short: Callable[[str], str]) -> dict[str, str]:
    """Return what is shown of each name: `short` of it, if that is not the same for another."""
    number = Counter(map(short, names))
    return {name: short(name) if number[short(name)] == 1 else name for name in names}


def _values(case: Case) -> list[tuple[str, Any]]:
    return [(key, _scalar(value)) for key, value in case.values]


def digits(value: float) -> str:
    """Return a number with three significant digits; empty if it is not finite."""
    if not math.isfinite(value):
        return ""
    value = float(f"{value:.3g}")
    size = math.floor(math.log10(abs(value))) if value else 0
    return f"{value:.2e}" if size < -4 else f"{value:.{max(0, 2 - size)}f}"


def show(console: Console, flown: Sequence[Group]) -> None:
    """Print the groups block by block, the legend, and why flights failed."""
    table = Table(box=None, pad_edge=False)
    separator = " " if console.width > DEFAULT_WIDTH else "\n"
    table.add_column("controller", overflow="fold")
    for _, title in SHOWN:
        table.add_column(Text(title), justify="right", no_wrap=True)
    for block, members in itertools.groupby(flown, lambda group: group.block):
        table.add_row(Text(f"\n{block}", "bold"))
        for group in members:
            mark, style = ("*", "bold") if group.best else (" ", "" if group.successes else "red")
            part = f" ({group.successes} of {group.flights})" if group.failed else ""
            medians = [digits(group.spread(metric)[1]) for metric, _ in SHOWN[1:]]
            cells = (group.shown(ERROR).replace(" ", separator), *medians)
            table.add_row(Text(f"{mark} {group.name}{part}"), *map(Text, cells), style=style)
    console.print(table)
    console.print()
    for line in LEGEND:
        console.print(Text(line, "dim"))
    for group in flown:
        for reason, seeds in group.reasons.items():
            where = f"{group.name}, {group.block}, seed {', '.join(map(str, seeds))}"
            console.print(Text(f"failed: {where}: {reason}", "red"))


# ---------------------------------------------------------------------- the page


def page(
    groups: Sequence[Group],
    missing: Sequence[str] = (),
    links: Callable[[Row], Mapping[str, str]] = lambda row: {},
) -> str:
    """Return the page of a campaign as HTML. `missing` says what is not flown; `links` returns the
    files of a kept flight by name, with paths relative to the page."""
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
    """Return a description of a flight: its names, values and seed."""
    names = [name for column in CASE_COLUMNS if (name := getattr(row.case, column))]
    values = [f"{key}={value}" for key, value in row.case.values]
    return ", ".join([*names, *values, f"seed {row.case.seed}"])


def _figure(groups: Sequence[Group]) -> Figure:
    """Draw the panels side by side, one line per group, with a heading above each block."""
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
    """Draw the quartiles of a group, and its outliers as dots."""
    return go.Box(
        x=coordinates(group.values(name)), y0=at, orientation="h", width=0.6, name=group.name,
        line={"color": colour, "width": 1.4}, marker={"color": colour, "size": 3},
        hoverinfo="x", boxpoints="outliers",
    )  # fmt: skip
