"""The page of a comparison: errors and agitation per scenario, and the whole table."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence

import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from offboard.analysis.compare import FIGURES, Row

_STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;margin:1.5rem auto;max-width:1200px;color:#1f2933}"
    "table{border-collapse:collapse;font-size:13px;font-variant-numeric:tabular-nums}"
    "td,th{padding:.25rem .6rem;border-bottom:1px solid #e4e7eb;text-align:right}"
    "td.text,th.text{text-align:left}tr.best td{font-weight:600}tr.failed td{color:#ba2525}"
)


def page(rows: Sequence[Row]) -> str:
    """One self-contained HTML document, plotly.js inside."""
    drawn = "".join(
        _figure(rows, name, title).to_html(full_html=False, include_plotlyjs=False)
        for name, title in (
            ("rmse_position_m", "position error, RMSE [m]: median and range over seeds"),
            ("rate_agitation_radps", "roll and pitch rate about the reference [rad/s]"),
        )
    )
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Comparison</title>'
        f"<style>{_STYLE}</style><script>{get_plotlyjs()}</script></head><body>"
        f"<h1>Controllers side by side</h1>{drawn}{_table(rows)}</body></html>"
    )


def _figure(rows: Sequence[Row], name: str, title: str) -> go.Figure:
    figure = go.Figure()
    for controller in dict.fromkeys(row.controller for row in rows):
        own = [row for row in rows if row.controller == controller]
        middle = [row.median[name] for row in own]
        figure.add_bar(
            name=controller,
            x=[f"{row.scenario}, {row.reference}" for row in own],
            y=middle,
            error_y={
                "type": "data",
                "symmetric": False,
                "array": [row.highest[name] - row.median[name] for row in own],
                "arrayminus": [row.median[name] - row.lowest[name] for row in own],
            },
        )
    figure.update_layout(title=title, barmode="group", yaxis_type="log", template="plotly_white")
    return figure


def _table(rows: Sequence[Row]) -> str:
    head = "".join(f'<th class="text">{name}</th>' for name in ("reference", "scenario", "law"))
    head += "<th>flights</th>" + "".join(f"<th>{name}</th>" for name in FIGURES)
    body = "".join(_line(row) for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _line(row: Row) -> str:
    names = "".join(
        f'<td class="text">{html.escape(name)}</td>'
        for name in (row.reference, row.scenario, row.controller)
    )
    if row.failed == row.flights:
        why = f'<td class="text" colspan="{len(FIGURES)}">{html.escape(row.why)}</td>'
        return f'<tr class="failed">{names}<td>0 of {row.flights}</td>{why}</tr>'
    cells = "".join(f"<td>{_cell(row, name)}</td>" for name in FIGURES)
    flights = f"{row.flights - row.failed} of {row.flights}"
    return f'<tr class="{"best" if row.best else ""}">{names}<td>{flights}</td>{cells}</tr>'


def _cell(row: Row, name: str) -> str:
    middle = row.median[name]
    if math.isnan(middle):
        return ""
    if row.lowest[name] == row.highest[name]:
        return f"{middle:.3g}"
    return f"{middle:.3g} [{row.lowest[name]:.3g}–{row.highest[name]:.3g}]"
