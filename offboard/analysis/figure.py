"""A figure of the page: plotly's traces and layout as plain data, and how ours look.

Knows the drawing only, not what is drawn. Numbers are rounded to what a screen can show.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

Trace = dict[str, Any]

INK, GRID, PAPER = "#1f2933", "#e4e7eb", "#ffffff"
BLUE, RED, GREEN, ORANGE, PURPLE, GREY = (
    "#2b6cb0", "#c53030", "#2f855a", "#c05621", "#6b46c1", "#829ab1",
)  # fmt: skip
PALETTE = (
    BLUE, RED, GREEN, ORANGE, PURPLE, "#0f766e", "#b83280", "#744210", "#4a5568", "#d69e2e",
    "#3182ce",
)  # fmt: skip
_DIGITS = 6
_PANEL_PX, _TOP_PX, _GAP = 190, 60, 0.09


@dataclass(frozen=True, slots=True)
class Figure:
    """`caption` says what it shows and what to compare it with."""

    title: str
    traces: Sequence[Trace]
    layout: Mapping[str, Any]
    caption: str = ""

    def to_json(self) -> str:
        document = {
            "title": self.title,
            "caption": self.caption,
            "data": list(self.traces),
            "layout": {**_BASE, **self.layout},
        }
        return json.dumps(document, separators=(",", ":"), allow_nan=False)


def line(
    x: ArrayLike, y: ArrayLike, name: str, colour: str, *, panel: int = 1, **rest: Any
) -> Trace:
    """A curve in panel 1, 2, ... of `panels`."""
    dash = rest.pop("dash", "solid")
    return {
        "type": "scatter", "mode": "lines", "name": name, "legendgroup": name,
        "x": numbers(x), "y": numbers(y), "xaxis": axis("x", panel), "yaxis": axis("y", panel),
        "line": {"color": colour, "width": 1.4, "dash": dash}, **rest,
    }  # fmt: skip


def legend_beside() -> dict[str, Any]:
    """For many entries: a column at the right, clear of the toolbar."""
    return {"orientation": "v", "x": 1.01, "y": 1.0, "yanchor": "top"}


def axis(letter: str, panel: int) -> str:
    """Plotly's name of the axis of a panel, counted from 1: x, x2, x3 ..."""
    return letter if panel == 1 else f"{letter}{panel}"


def panels(titles: Sequence[str], x_title: str, **y_extra: Any) -> dict[str, Any]:
    """Layout of panels one above the other that share their x axis."""
    count = len(titles)
    gap = _GAP / max(count - 1, 1) if count > 3 else _GAP / 2
    height = (1.0 - gap * (count - 1)) / count
    layout: dict[str, Any] = {"height": _TOP_PX + _PANEL_PX * count + 50}
    for i, title in enumerate(titles):
        top = 1.0 - i * (height + gap)
        number = "" if i == 0 else str(i + 1)
        last = i == count - 1
        layout[f"yaxis{number}"] = {
            **_AXIS, "title": {"text": title}, "domain": [max(top - height, 0.0), top],
            "anchor": axis("x", i + 1), **y_extra,
        }  # fmt: skip
        layout[f"xaxis{number}"] = {
            **_AXIS, "anchor": axis("y", i + 1), "showticklabels": last,
            **({} if i == 0 else {"matches": "x"}),
            **({"title": {"text": x_title}} if last else {}),
        }  # fmt: skip
    return layout


def numbers(values: ArrayLike) -> list[float | None]:
    """Rounded to six significant digits, None for what is not finite."""
    array = np.asarray(values, np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        magnitude = np.where(array == 0, 1.0, np.abs(array))
    return [
        round(v, _DIGITS - 1 - math.floor(math.log10(m))) if math.isfinite(v) else None
        for v, m in zip(array.tolist(), magnitude.tolist(), strict=True)
    ]


_AXIS: dict[str, Any] = {
    "gridcolor": GRID, "zerolinecolor": GRID, "linecolor": GREY, "showline": True,
    "ticks": "outside", "tickcolor": GREY, "automargin": True,
    "exponentformat": "power",
}  # fmt: skip
_BASE: dict[str, Any] = {
    "font": {"family": "system-ui, sans-serif", "size": 13, "color": INK},
    "paper_bgcolor": PAPER, "plot_bgcolor": PAPER,
    "margin": {"l": 70, "r": 20, "t": 40, "b": 50},
    "legend": {
        "orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom", "groupclick": "togglegroup",
    },
    "hovermode": "closest", "autosize": True,
}  # fmt: skip


def single(x_title: str, y_title: str, **extra: Any) -> dict[str, Any]:
    """Layout of one panel; `x` and `y` in extra are merged into the axes."""
    return {
        "height": extra.pop("height", 430),
        "xaxis": {**_AXIS, "title": {"text": x_title}, **extra.pop("x", {})},
        "yaxis": {**_AXIS, "title": {"text": y_title}, **extra.pop("y", {})},
        **extra,
    }
