"""The page: one self-contained HTML document, plotly.js inside, no network. Text in, text out."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence

from plotly.offline import get_plotlyjs

from offboard.analysis.paper.figure import Figure
from offboard.analysis.paper.printed import DOI
from offboard.analysis.paper.table import Table, shown

Piece = Table | Figure
SECTIONS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("The tables", ("table 2", "figure gap", "table 3", "table 4")),
    ("The figures", tuple(f"figure {number}" for number in range(4, 18))),
    ("Errata, by computation", ("table errata", "table bd")),
    (
        "Why one step is not enough",
        ("table horizon", "figure horizon", "figure laws", "table weights"),
    ),
    (
        "What its conclusions ask for",
        ("table integral", "figure integral", "table limits", "figure limits"),
    ),
    ("The swarm among its peers", ("figure peers", "table peers")),
)

_STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #1f2933; background: #f5f7fa; margin: 0; }
main { max-width: 1280px; margin: 0 auto; padding: 1rem 1.5rem 4rem; }
h1 { font-size: 1.6rem; margin: 1rem 0 .3rem; } h2 { font-size: 1.3rem; margin: 2.5rem 0 .6rem; }
h3 { font-size: 1.05rem; margin: 0 0 .5rem; }
nav a { margin-right: 1.2rem; }
a { color: #2b6cb0; }
section > article { background: #fff; border: 1px solid #e4e7eb; border-radius: 6px;
  padding: 1rem 1.2rem; margin: 0 0 1.2rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .5rem; border-bottom: 1px solid #e4e7eb; text-align: right;
  vertical-align: top; white-space: nowrap; }
th { background: #f0f4f8; font-weight: 600; white-space: normal; vertical-align: bottom; }
th.text, td.text { text-align: left; }
td.long { white-space: normal; min-width: 12rem; max-width: 30rem; }
td.printed { color: #829ab1; }
.note { color: #52606d; font-size: 13px; margin: .5rem 0 0; }
.missing { background: #fffbea; border: 1px solid #f0b429; padding: .6rem 1rem; }
dl.run { display: grid; grid-template-columns: max-content auto; gap: 0 1rem; font-size: 13px; }
dd { margin: 0; }
"""

_WORDS = ' class="text"'
_LONG = 44  # characters; a longer cell may break

_SCRIPT = """
for (const element of document.querySelectorAll(".figure")) {
  const figure = JSON.parse(document.getElementById(element.dataset.source).textContent);
  Plotly.newPlot(element, figure.data, figure.layout, {
    responsive: true, displaylogo: false, displayModeBar: true,
    toImageButtonOptions: {format: "png", scale: 2, filename: element.id}
  }).then(() => { element.dataset.drawn = "yes"; });
}
"""


def page(
    pieces: Mapping[str, Piece], missing: Mapping[str, str], facts: Sequence[tuple[str, str]]
) -> str:
    """`pieces` by label ("table 2", "figure gap"); `missing`, label -> why; `facts` of the run."""
    body = [
        "<h1>Linear controller design with PSO for UAV trajectory tracking: "
        "the paper and ours</h1>",
        f'<p>Proc. SPIE 11442, 114420Z (2020), <a href="https://doi.org/{DOI}">doi {DOI}</a>. '
        "Grey figures are printed in the paper; all others are computed here. Each figure has a "
        "button, at its upper right, that saves it as an image.</p>",
        _facts(facts),
    ]
    if missing:
        items = "".join(
            f"<li>{html.escape(label)}: {html.escape(why)}</li>" for label, why in missing.items()
        )
        body.append(f'<div class="missing">Not on this page:<ul>{items}</ul></div>')
    sections = [(title, [n for n in names if n in pieces]) for title, names in SECTIONS]
    sections = [(title, names) for title, names in sections if names]
    links = "".join(
        f'<a href="#s{i}">{html.escape(title)}</a>' for i, (title, _) in enumerate(sections)
    )
    body.append(f"<nav>{links}</nav>")
    for i, (title, names) in enumerate(sections):
        articles = "".join(_article(name, pieces[name]) for name in names)
        body.append(f'<section id="s{i}"><h2>{html.escape(title)}</h2>{articles}</section>')
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>The paper and ours</title><style>{_STYLE}</style>"
        f"<script>{get_plotlyjs()}</script></head><body><main>{''.join(body)}</main>"
        f"<script>{_SCRIPT}</script></body></html>\n"
    )


def _article(name: str, piece: Piece) -> str:
    identity = name.replace(" ", "_")
    title = f"<h3>{html.escape(piece.title)}</h3>"
    if isinstance(piece, Table):
        return f'<article id="{identity}">{title}{_table(piece)}{_notes(piece.notes)}</article>'
    data = piece.to_json().replace("</", "<\\/")
    height = int(piece.layout.get("height", 430))
    return (
        f"<article>{title}"
        f'<div class="figure" id="{identity}" data-source="{identity}_data" '
        f'style="height:{height}px"></div>'
        f'<script type="application/json" id="{identity}_data">{data}</script>'
        f"{_notes([piece.caption] if piece.caption else [])}</article>"
    )


def _table(table: Table) -> str:
    worded = {
        column.key
        for column in table.columns
        if any(isinstance(row.get(column.key), str) for row in table.rows)
    }
    heads = "".join(
        f"<th{_WORDS if column.key in worded else ''}>{html.escape(column.heading)}</th>"
        for column in table.columns
    )
    rows = []
    for row in table.rows:
        cells = []
        for column in table.columns:
            value = row.get(column.key)
            kinds = ["text"] if column.key in worded else []
            kinds += ["long"] if isinstance(value, str) and len(value) > _LONG else []
            kinds += ["printed"] if "printed" in column.key else []
            mark = f' class="{" ".join(kinds)}"' if kinds else ""
            cells.append(f"<td{mark}>{html.escape(shown(value))}</td>")
        rows.append(f"<tr>{''.join(cells)}</tr>")
    return f'<div class="scroll"><table><tr>{heads}</tr>{"".join(rows)}</table></div>'


def _notes(notes: Sequence[str]) -> str:
    return "".join(f'<p class="note">{html.escape(note)}</p>' for note in notes)


def _facts(facts: Sequence[tuple[str, str]]) -> str:
    pairs = "".join(f"<dt>{html.escape(k)}</dt><dd>{html.escape(v)}</dd>" for k, v in facts)
    return f'<dl class="run">{pairs}</dl>'


def facts_json(facts: Sequence[tuple[str, str]], missing: Mapping[str, str]) -> str:
    """The same facts for a program."""
    return json.dumps({"run": dict(facts), "missing": dict(missing)}, indent=1) + "\n"
