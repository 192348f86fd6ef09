"""The shell of every page: one self-contained HTML document, plotly.js inside, no network.

Knows how a page looks and draws itself, not what is on it. Text in, text out.
"""

from __future__ import annotations

import html
from collections.abc import Sequence

from plotly.offline import get_plotlyjs

from offboard.analysis.figure import Figure

_HEIGHT_PX = 430  # of a figure whose layout says nothing

_STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #1f2933; background: #f5f7fa; margin: 0; }
main { max-width: 1280px; margin: 0 auto; padding: 1rem 1.5rem 4rem; }
h1 { font-size: 1.6rem; margin: 1rem 0 .3rem; } h2 { font-size: 1.3rem; margin: 2.5rem 0 .6rem; }
h3 { font-size: 1.05rem; margin: 0 0 .5rem; }
nav a { margin-right: 1.2rem; }
a { color: #2b6cb0; }
article { background: #fff; border: 1px solid #e4e7eb; border-radius: 6px;
  padding: 1rem 1.2rem; margin: 0 0 1.2rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .5rem; border-bottom: 1px solid #e4e7eb; text-align: right;
  vertical-align: top; white-space: nowrap; }
th { background: #f0f4f8; font-weight: 600; white-space: normal; vertical-align: bottom; }
th.text, td.text { text-align: left; }
td.long { white-space: normal; min-width: 12rem; max-width: 30rem; }
td.printed { color: #829ab1; }
tr.best td { font-weight: 600; } tr.failed td { color: #ba2525; }
.note { color: #52606d; font-size: 13px; margin: .5rem 0 0; }
.missing { background: #fffbea; border: 1px solid #f0b429; padding: .6rem 1rem; }
dl.run { display: grid; grid-template-columns: max-content auto; gap: 0 1rem; font-size: 13px; }
dd { margin: 0; }
"""

_SCRIPT = """
for (const element of document.querySelectorAll(".figure")) {
  const figure = JSON.parse(document.getElementById(element.dataset.source).textContent);
  Plotly.newPlot(element, figure.data, figure.layout, {
    responsive: true, displaylogo: false, displayModeBar: true,
    toImageButtonOptions: {format: "png", scale: 2, filename: element.id}
  }).then(() => { element.dataset.drawn = "yes"; });
}
"""


def document(title: str, body: str) -> str:
    """The whole document round its body, which is HTML; `title` is text."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style>"
        f"<script>{get_plotlyjs()}</script></head><body><main>{body}</main>"
        f"<script>{_SCRIPT}</script></body></html>\n"
    )


def drawing(identity: str, figure: Figure) -> str:
    """An article with a figure, which the page draws when it is opened."""
    data = figure.to_json().replace("</", "<\\/")
    height = int(figure.layout.get("height", _HEIGHT_PX))
    return (
        f"<article><h3>{html.escape(figure.title)}</h3>"
        f'<div class="figure" id="{identity}" data-source="{identity}_data" '
        f'style="height:{height}px"></div>'
        f'<script type="application/json" id="{identity}_data">{data}</script>'
        f"{notes([figure.caption] if figure.caption else [])}</article>"
    )


def table(head: str, rows: Sequence[str]) -> str:
    """A table that scrolls where the window is too narrow; cells and rows are HTML."""
    return f'<div class="scroll"><table><tr>{head}</tr>{"".join(rows)}</table></div>'


def notes(texts: Sequence[str]) -> str:
    """Small print, a paragraph for each."""
    return "".join(f'<p class="note">{html.escape(text)}</p>' for text in texts)
