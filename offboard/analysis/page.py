"""HTML pages from Jinja2 templates: one self-contained file each, plotly.js inside, no network.

A template is named by its path in this package: "campaign/templates/campaign.html". Templates
extend "analysis/templates/page.html" and draw figures and notes with the macros of "parts.html".
Values are escaped.
"""

from __future__ import annotations

from jinja2 import Environment, PackageLoader, StrictUndefined
from plotly.offline import get_plotlyjs

from offboard.analysis import figure

_TEMPLATES = Environment(
    loader=PackageLoader("offboard", ""), autoescape=True, undefined=StrictUndefined,
    trim_blocks=True, lstrip_blocks=True,
)  # fmt: skip
_COLOURS = {  # names of the CSS variables
    "ink": figure.INK, "muted": figure.MUTED, "grid": figure.GRID, "surface": figure.SURFACE,
    "background": figure.BACKGROUND, "link": figure.BLUE, "failed": figure.RED,
    "warning": figure.YELLOW, "printed": figure.GREY,
}  # fmt: skip


def render(template: str, **values: object) -> str:
    """The page that `template` makes of `values`, as the text of an HTML file."""
    return _TEMPLATES.get_template(template).render(
        plotly_js=get_plotlyjs(),
        colours=_COLOURS,
        dark=figure.DARK,
        style=figure.STYLE.to_plotly_json(),
        **values,
    )
