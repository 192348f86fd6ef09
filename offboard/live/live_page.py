"""The live page: figures without points, which its script fills from server-sent events."""

from __future__ import annotations

from typing import Any

import plotly.graph_objects as go

from offboard.analysis.page import BLUE, INK, STYLE, Figure, curve, panels, render


def page() -> str:
    """The page as text."""
    return render(
        "live/templates/live.html", title="Live flight",
        figures={"plan": _plan(), "curves": _curves()},
    )  # fmt: skip


def _plan() -> Figure:
    figure = go.Figure()
    lines: tuple[tuple[str, dict[str, Any]], ...] = (
        ("reference", {"color": INK, "dash": "dash", "width": 1.4}),
        ("estimated", {"color": BLUE, "width": 2}),
    )
    for name, style in lines:
        figure.add_trace(go.Scatter(x=[], y=[], mode="lines", name=name, line=style))
    figure.add_trace(
        go.Scatter(x=[], y=[], mode="markers", showlegend=False, marker={"color": BLUE, "size": 10})
    )
    # a vehicle at rest has no axis of millimetres
    unseen = {"mode": "markers", "opacity": 0, "hoverinfo": "skip", "showlegend": False}
    figure.add_trace(go.Scatter(x=[-1, 1], y=[-1, 1], **unseen))
    figure.update_layout(template=STYLE, height=560)
    figure.update_xaxes(title_text="east, m")
    figure.update_yaxes(title_text="north, m", scaleanchor="x")
    return Figure("Path from above", figure)


def _curves() -> Figure:
    figure = panels(
        ("height, m", "distance from the reference, m", "link age, ms"), "vehicle time, s"
    )
    for place in (1, 2, 3):
        curve(figure, place, [], [], "estimated", BLUE, showlegend=False)
    figure.update_yaxes(rangemode="tozero", row=3)
    return Figure("Curves", figure)
