"""The page of a comparison: errors and agitation of every law per scenario, and all figures."""

from __future__ import annotations

import html
import itertools
from collections.abc import Sequence

from offboard.analysis import page as shell
from offboard.analysis.compare import EQUAL_SHARE, FIGURES, Row
from offboard.analysis.compare_table import digits
from offboard.analysis.figure import GREY, PALETTE, Figure, Trace, numbers, single

SHOWN = {
    "rmse_position_m": "Position error, RMSE [m]",
    "tilt_agitation_deg": "Tilt about what the reference asks for, RMS [deg]",
    "rate_agitation_radps": "Roll and pitch rate about what the reference asks for, RMS [rad/s]",
}
EQUALS = (
    "Filled: the lowest median error of its scenario, and its equals, which are all whose median "
    f"lies within the range of that one's flights, or within {EQUAL_SHARE:.0%} of its median."
)
_ROW_PX, _BETWEEN, _FRAME_PX = 17, 1, 130


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
    body += [shell.drawing(name, _figure(rows, name, title)) for name, title in SHOWN.items()]
    body.append(f"<article><h3>All figures: median [lowest–highest]</h3>{_table(rows)}</article>")
    return shell.document("Controllers side by side", "".join(body))


def _figure(rows: Sequence[Row], name: str, title: str) -> Figure:
    """A dot and its range for every law, scenarios one below the other."""
    places, heads = _places(rows)
    controllers = list(dict.fromkeys(row.controller for row in rows))
    placed = list(zip(rows, places, strict=True))
    traces = [
        _trace([pair for pair in placed if pair[0].controller == law], name, colour)
        for law, colour in zip(controllers, itertools.cycle(PALETTE), strict=False)
    ]
    below = max(places, default=0) + 1
    layout = single(
        title,
        "",
        height=_FRAME_PX + _ROW_PX * (below + 1),
        x={"type": "log", "side": "bottom", "minor": {"showgrid": True}},
        y={
            "tickvals": list(heads.values()),
            "ticktext": list(heads),
            "range": [below, -1],
            "showgrid": False,
            "zeroline": False,
        },
        shapes=[_border(place) for place in _borders(rows, places)],
        annotations=[_failure(row, at) for row, at in placed if row.failed],
    )
    return Figure(title, traces, layout, f"Dot: median; line: range over the seeds. {EQUALS}")


def _places(rows: Sequence[Row]) -> tuple[list[int], dict[str, float]]:
    """Where each row is drawn, and where the name of each reference and scenario stands."""
    places: list[int] = []
    heads: dict[str, float] = {}
    several = len({row.reference for row in rows}) > 1
    at = 0
    for (reference, scenario), block in itertools.groupby(rows, _cell):
        count = len(list(block))
        heads[f"{scenario}, {reference}" if several else scenario] = at + (count - 1) / 2
        places += range(at, at + count)
        at += count + _BETWEEN
    return places, heads


def _cell(row: Row) -> tuple[str, str]:
    return row.reference, row.scenario


def _borders(rows: Sequence[Row], places: Sequence[int]) -> list[float]:
    pairs = itertools.pairwise(zip(rows, places, strict=True))
    return [
        (first + second) / 2
        for (row, first), (next_row, second) in pairs
        if _cell(row) != _cell(next_row)
    ]


def _trace(own: Sequence[tuple[Row, int]], name: str, colour: str) -> Trace:
    shown = [(row, place) for row, place in own if row.flown]
    return {
        "type": "scatter", "mode": "markers", "name": own[0][0].controller,
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


def _border(place: float) -> dict[str, object]:
    return {
        "type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": place, "y1": place,
        "line": {"color": GREY, "width": 0.5},
    }  # fmt: skip


def _failure(row: Row, place: int) -> dict[str, object]:
    return {
        "xref": "paper", "x": 1, "xanchor": "right", "y": place, "showarrow": False,
        "text": html.escape(f"{row.controller}: {row.failed} of {row.flights} failed"),
        "font": {"color": "#ba2525", "size": 11},
    }  # fmt: skip


def _table(rows: Sequence[Row]) -> str:
    head = "".join(f'<th class="text">{name}</th>' for name in ("reference", "scenario", "law"))
    head += "<th>flights</th>" + "".join(f"<th>{name}</th>" for name in FIGURES)
    note = shell.notes([EQUALS.replace("Filled", "Bold, with a star")])
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
