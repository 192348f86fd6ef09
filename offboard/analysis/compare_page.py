"""The page of a comparison: errors and agitation of every law per scenario, and all figures."""

from __future__ import annotations

import html
import itertools
import math
from collections.abc import Sequence

from offboard.analysis import page as shell
from offboard.analysis.compare import EQUAL_SHARE, FIGURES, Row
from offboard.analysis.compare_table import digits
from offboard.analysis.figure import GREY, GRID, PALETTE, Figure, Trace, axis, numbers

PANELS = {  # figure of the score: title, and the share of the width it is drawn in
    "rmse_position_m": ("position error<br>RMSE [m]", (0.0, 0.47)),
    "tilt_agitation_deg": ("tilt not asked for<br>RMS [deg]", (0.53, 0.74)),
    "rate_agitation_radps": ("rates not asked for<br>RMS [rad/s]", (0.8, 1.0)),
}
EQUALS = (
    "the lowest median error of its scenario, and its equals, which are all whose median lies "
    f"within the range of that one's flights, or within {EQUAL_SHARE:.0%} of its median."
)
CAPTION = (
    "Dot: median; line: range over the seeds. Not asked for: about what the reference asks of an "
    f"ideal vehicle. Filled and bold: {EQUALS}"
)
FAILED = "#ba2525"
FEW_DECADES = 2
_AIR = 0.05  # of a decade, beside the outermost ticks
_ROW_PX, _FRAME_PX = 18, 120  # the toolbar and the axes above


def page(rows: Sequence[Row], missing: Sequence[str] = ()) -> str:
    """One self-contained HTML document; `missing` says what was not flown."""
    references = ", ".join(dict.fromkeys(row.reference for row in rows))
    flights = sum(row.flights for row in rows)
    body = [
        "<h1>Controllers side by side</h1>",
        f"<p>{html.escape(references)}: {flights} flights, each law with the same seeds.</p>",
    ]
    if missing:
        items = "".join(f"<li>{html.escape(line)}</li>" for line in missing)
        body.append(f'<div class="missing">Interrupted:<ul>{items}</ul></div>')
    body.append(shell.drawing("comparison", _figure(rows)))
    body.append(f"<article><h3>All figures: median [lowest–highest]</h3>{_table(rows)}</article>")
    return shell.document("Controllers side by side", "".join(body))


def _figure(rows: Sequence[Row]) -> Figure:
    """Panels side by side with one line for every law, under the name of its scenario."""
    lines = _lines(rows)
    placed = [(row, place) for place, row in enumerate(lines) if isinstance(row, Row)]
    controllers = list(dict.fromkeys(row.controller for row in rows))
    traces = [
        _trace([pair for pair in placed if pair[0].controller == law], name, colour, panel)
        for law, colour in zip(controllers, itertools.cycle(PALETTE), strict=False)
        for panel, name in enumerate(PANELS, 1)
    ]
    layout = {
        "height": _FRAME_PX + _ROW_PX * len(lines),
        "margin": {"l": 120, "r": 20, "t": 110, "b": 10},
        "showlegend": False,
        "yaxis": {
            "tickvals": list(range(len(lines))),
            "ticktext": [_label(line) for line in lines],
            "range": [len(lines) - 0.3, -0.7],
            "showgrid": False,
            "zeroline": False,
            "fixedrange": True,
        },
        "shapes": [_border(at) for at, line in enumerate(lines) if at and isinstance(line, str)],
        "annotations": [_failure(row, at) for row, at in placed if row.failed],
    }
    for panel, (name, (title, domain)) in enumerate(PANELS.items(), 1):
        layout["xaxis" if panel == 1 else f"xaxis{panel}"] = {
            **_logarithmic(rows, name), "title": {"text": title}, "domain": domain,
        }  # fmt: skip
    return Figure("Error, and the agitation that it took", traces, layout, CAPTION)


def _lines(rows: Sequence[Row]) -> list[Row | str]:
    """The rows, above each block the name of its scenario, and of the reference if it varies."""
    several = len({row.reference for row in rows}) > 1
    lines: list[Row | str] = []
    for (reference, scenario), block in itertools.groupby(rows, _cell):
        lines += [f"{scenario}, {reference}" if several else scenario, *block]
    return lines


def _cell(row: Row) -> tuple[str, str]:
    return row.reference, row.scenario


def _label(line: Row | str) -> str:
    if isinstance(line, str):
        return f"<b>{html.escape(line)}</b>"
    name = html.escape(line.controller)
    return f"<b>{name}</b>" if line.best else name


def _logarithmic(rows: Sequence[Row], name: str) -> dict[str, object]:
    """An axis above its panel from tick to tick, at 1 or at 1, 2 and 5 of every decade."""
    ends = [end for row in rows for end in (row.lowest[name], row.highest[name]) if end > 0.0]
    low = math.floor(math.log10(min(ends, default=1.0)))
    high = math.ceil(math.log10(max(ends, default=1.0)))
    steps = (1, 2, 5) if high - low <= FEW_DECADES else (1,)
    ticks = [float(f"{step}e{power}") for power in range(low, high + 1) for step in steps]
    first = max((at for at in ticks if at <= min(ends, default=1.0)), default=ticks[0])
    last = min((at for at in ticks if at >= max(ends, default=1.0)), default=ticks[-1])
    return {
        "type": "log", "side": "top",
        "range": [math.log10(first) - _AIR, math.log10(last) + _AIR],
        "tickvals": ticks, "ticktext": [f"{at:g}" for at in ticks],
        "gridcolor": GRID, "linecolor": GREY, "showline": True, "minor": {"showgrid": False},
    }  # fmt: skip


def _trace(own: Sequence[tuple[Row, int]], name: str, colour: str, panel: int) -> Trace:
    shown = [(row, place) for row, place in own if row.flown]
    return {
        "type": "scatter", "mode": "markers", "xaxis": axis("x", panel), "yaxis": "y",
        "x": numbers([row.median[name] for row, _ in shown]),
        "y": [place for _, place in shown],
        "text": [_hover(row, name) for row, _ in shown], "hoverinfo": "text",
        "marker": {
            "color": colour, "size": 9, "line": {"color": colour, "width": 2},
            "symbol": ["circle" if row.best else "circle-open" for row, _ in shown],
        },
        "error_x": {
            "type": "data", "symmetric": False, "thickness": 1.5, "width": 3, "color": colour,
            "array": numbers([row.highest[name] - row.median[name] for row, _ in shown]),
            "arrayminus": numbers([row.median[name] - row.lowest[name] for row, _ in shown]),
        },
    }  # fmt: skip


def _hover(row: Row, name: str) -> str:
    return html.escape(f"{row.controller}, {row.scenario}, {row.reference}: {_value(row, name)}")


def _border(heading: int) -> dict[str, object]:
    place = heading - 0.5
    return {
        "type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": place, "y1": place,
        "line": {"color": GRID, "width": 1},
    }  # fmt: skip


def _failure(row: Row, place: int) -> dict[str, object]:
    return {
        "xref": "paper", "x": 0, "xanchor": "left", "y": place, "showarrow": False,
        "text": f"{row.failed} of {row.flights} failed",
        "font": {"color": FAILED, "size": 11},
    }  # fmt: skip


def _table(rows: Sequence[Row]) -> str:
    head = "".join(f'<th class="text">{name}</th>' for name in ("reference", "scenario", "law"))
    head += "<th>flights</th>" + "".join(f"<th>{name}</th>" for name in FIGURES)
    note = shell.notes([f"Bold, with a star: {EQUALS}"])
    return shell.table(head, [_line(row) for row in rows]) + note


def _line(row: Row) -> str:
    law = row.controller + (" *" if row.best else "")
    names = "".join(
        f'<td class="text">{html.escape(name)}</td>' for name in (row.reference, row.scenario, law)
    )
    names += f"<td>{row.flown} of {row.flights}</td>"
    cells = "".join(f"<td>{_value(row, name)}</td>" for name in FIGURES)
    if not row.flown:
        cells = f'<td class="text long" colspan="{len(FIGURES)}">{html.escape(row.why)}</td>'
    elif row.failed:
        cells += f'<td class="text long">{html.escape(row.why)}</td>'
    kind = "failed" if not row.flown else "best" if row.best else ""
    return f'<tr class="{kind}">{names}{cells}</tr>'


def _value(row: Row, name: str) -> str:
    middle, low, high = (digits(ends[name]) for ends in (row.median, row.lowest, row.highest))
    return middle if low == high else f"{middle} [{low}–{high}]"
