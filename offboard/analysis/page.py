"""HTML pages from Jinja2 templates, and their plotly figures: one style for light and dark.

A page is one file that contains plotly.js and loads nothing from the network. A template is named
by its path below `offboard`: "campaign/templates/campaign.html". Templates extend
"analysis/templates/page.html" and draw figures and notes with the macros of "parts.html". Values
are escaped.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go
from jinja2 import Environment, PackageLoader, StrictUndefined
from numpy.typing import ArrayLike, NDArray
from plotly.offline import get_plotlyjs
from plotly.subplots import make_subplots

INK, MUTED, GRID, SURFACE, BACKGROUND = "#1f2933", "#52606d", "#e4e7eb", "#ffffff", "#f5f7fa"
BLUE, RED, GREEN, ORANGE, PURPLE, GREY = (
    "#2b6cb0", "#c53030", "#2f855a", "#c05621", "#6b46c1", "#617488",
)  # fmt: skip
# Backgrounds of bands with text on them
BLUE_BAND, ORANGE_BAND, GREY_BAND = "#cfe0f3", "#f6d9bd", "#dfe3e8"
TEAL, PINK, BROWN, SLATE, YELLOW = "#0f766e", "#b83280", "#744210", "#4a5568", "#b7791f"
PALETTE = (BLUE, RED, GREEN, ORANGE, PURPLE, TEAL, PINK, BROWN, SLATE, YELLOW)
# Figures are written in light colours; the page replaces each in the dark scheme
DARK = {
    INK: "#e6e9ed", MUTED: "#a5b1bd", GRID: "#343c46", SURFACE: "#1b2027", BACKGROUND: "#12161b",
    BLUE: "#6aaaf0", RED: "#f47c7c", GREEN: "#5cc48d", ORANGE: "#f2954f", PURPLE: "#b197fc",
    GREY: "#8d9bab", TEAL: "#4fd1c5", PINK: "#f18dc0", BROWN: "#c89b5d", SLATE: "#b8c2d0",
    YELLOW: "#e8c15c", BLUE_BAND: "#24405e", ORANGE_BAND: "#5e3c1c", GREY_BAND: "#2f3843",
}  # fmt: skip

_TOP_PX, _BOTTOM_PX, _PANEL_PX, _GAP_PX = 48, 90, 150, 36
_FEW_DECADES = 2  # a logarithmic axis of at most this many decades has ticks at 2 and 5, too
_MOST_DECADES = 3  # an axis of more decades does not have a tick at each
# `without_outliers` applies to at least 50 values whose range is over 4 times that of 99 % of them
_FEW_VALUES, _FLATTENED = 50, 4.0
_MARGIN = 0.02  # margin of a logarithmic axis at either end, as a share of its decades
_AXIS = {
    "gridcolor": GRID, "zerolinecolor": GRID, "linecolor": GREY, "showline": True,
    "ticks": "outside", "tickcolor": GREY, "automargin": True, "exponentformat": "power",
    "title": {"font": {"size": 13}},
}  # fmt: skip
_SCENE_AXIS = {"backgroundcolor": SURFACE, "gridcolor": GRID, "linecolor": GREY}
STYLE = go.layout.Template(
    layout={
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": INK},
        "paper_bgcolor": SURFACE, "plot_bgcolor": SURFACE, "hovermode": "closest",
        "margin": {"l": 50, "r": 15, "t": _TOP_PX, "b": _BOTTOM_PX}, "xaxis": _AXIS, "yaxis": _AXIS,
        "scene": {"xaxis": _SCENE_AXIS, "yaxis": _SCENE_AXIS, "zaxis": _SCENE_AXIS},
        "legend": {
            "orientation": "h", "x": 0, "y": 0, "yref": "container", "yanchor": "bottom",
            "groupclick": "togglegroup", "itemsizing": "constant",
        },
    }
)  # fmt: skip
_TEMPLATES = Environment(
    loader=PackageLoader("offboard", ""), autoescape=True, undefined=StrictUndefined,
    trim_blocks=True, lstrip_blocks=True,
)  # fmt: skip
_COLOURS = {  # name of the CSS variable -> colour
    "ink": INK, "muted": MUTED, "grid": GRID, "surface": SURFACE,
    "background": BACKGROUND, "link": BLUE, "failed": RED,
    "warning": YELLOW, "printed": GREY,
}  # fmt: skip


def render(template: str, **values: object) -> str:
    """Return an HTML page: `template` filled with `values`."""
    return _TEMPLATES.get_template(template).render(
        plotly_js=get_plotlyjs(),
        colours=_COLOURS,
        dark=DARK,
        style=STYLE.to_plotly_json(),
        **values,
    )


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure with its heading and the caption below it.

    A window narrower than `width_px` scrolls the figure instead of squeezing it.
    """

    title: str
    drawing: go.Figure
    caption: str = ""
    width_px: int = 0

    def to_json(self, *, styled: bool = True) -> str:
        """Return title, caption and figure as plotly's own JSON (`plotly.io.read_json` reads it).

        `styled`: whether the JSON contains `STYLE`; a page contains it once for all figures.
        """
        drawing = json.loads(self.drawing.to_json())
        if not styled:
            del drawing["layout"]["template"]
        document = {"title": self.title, "caption": self.caption, **drawing}
        return json.dumps(document, separators=(",", ":"), allow_nan=False)


def panels(titles: Sequence[str], x_title: str, panel_px: int = _PANEL_PX) -> go.Figure:
    """Return an empty figure with one panel per title, stacked, with a common x axis."""
    inner_px = panel_px * len(titles) + _GAP_PX * (len(titles) - 1)
    figure = make_subplots(
        rows=len(titles), shared_xaxes=True, subplot_titles=titles,
        vertical_spacing=_GAP_PX / inner_px,
    )  # fmt: skip
    figure.update_layout(template=STYLE, height=_TOP_PX + inner_px + _BOTTOM_PX)
    figure.update_annotations(x=0, xanchor="left", font_size=13)
    figure.update_xaxes(title_text=x_title, row=len(titles))
    return figure


def without_outliers(values: NDArray[np.float64]) -> list[float] | None:
    """Return the range of an axis that shows 99 % of the values, if outliers would flatten them;
    else None."""
    known = values[np.isfinite(values)]
    if len(known) < _FEW_VALUES:
        return None
    low, high = np.percentile(known, (0.5, 99.5)).tolist()
    span = high - low
    if np.ptp(known) <= _FLATTENED * span or not span:
        return None
    return [low - 0.1 * span, high + 0.1 * span]


def logarithmic(values: Iterable[float]) -> dict[str, Any]:
    """Return a logarithmic axis around the positive values. Up to two decades have ticks at 1, 2
    and 5; more decades have about three ticks, at powers of ten."""
    known = [value for value in values if 0.0 < value < math.inf]
    least, greatest = min(known, default=1.0), max(known, default=1.0)
    low, high = math.floor(math.log10(least)), math.ceil(math.log10(greatest))
    steps = (1, 2, 5) if high - low <= _FEW_DECADES else (1,)
    ticks = [float(f"{step}e{power}") for power in range(low, high + 1) for step in steps]
    first = max((at for at in ticks if at <= least), default=ticks[0])
    last = min((at for at in ticks if at >= greatest), default=ticks[-1])
    margin = _MARGIN * (1 + high - low)
    shown = ticks[:: math.ceil((high - low) / _MOST_DECADES) or 1]
    return {
        "type": "log", "tickvals": shown, "ticktext": [f"{at:g}" for at in shown],
        "range": [math.log10(first) - margin, math.log10(last) + margin],
    }  # fmt: skip


def curve(
    figure: go.Figure, panel: int, x: ArrayLike, y: ArrayLike, name: str, colour: str,
    dash: str = "solid", **scatter: Any,
) -> None:  # fmt: skip
    """Add a curve to panel 1, 2, ...; curves of the same name share one entry of the legend."""
    line = {"color": colour, "width": 1.4, "dash": dash, **scatter.pop("line", {})}
    shown = {other.name for other in figure.data if other.showlegend}
    trace = go.Scatter(
        x=coordinates(x), y=coordinates(y), name=name, legendgroup=name, line=line,
        **{"mode": "lines", "showlegend": name not in shown, **scatter},
    )  # fmt: skip
    figure.add_trace(trace, row=panel, col=1)


def coordinates(values: ArrayLike) -> NDArray[np.float32]:
    """Round to float32, which has more digits than a screen shows. Plotly writes it in base64."""
    return np.asarray(values, np.float32)
