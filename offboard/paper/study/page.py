"""What is on the page of `offboard paper`, in reading order. Text in, text out."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence

from offboard.analysis import page as shell
from offboard.analysis.figure import Figure
from offboard.paper.study.printed import DOI
from offboard.paper.study.table import Table, shown

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

_WORDS = ' class="text"'
_LONG = 44  # characters; a longer cell may break


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
    return shell.document("The paper and ours", "".join(body))


def _article(name: str, piece: Piece) -> str:
    identity = name.replace(" ", "_")
    if isinstance(piece, Figure):
        return shell.drawing(identity, piece)
    title = f"<h3>{html.escape(piece.title)}</h3>"
    return f'<article id="{identity}">{title}{_table(piece)}{shell.notes(piece.notes)}</article>'


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
    return shell.table(heads, rows)


def _facts(facts: Sequence[tuple[str, str]]) -> str:
    pairs = "".join(f"<dt>{html.escape(k)}</dt><dd>{html.escape(v)}</dd>" for k, v in facts)
    return f'<dl class="run">{pairs}</dl>'


def facts_json(facts: Sequence[tuple[str, str]], missing: Mapping[str, str]) -> str:
    """The same facts for a program."""
    return json.dumps({"run": dict(facts), "missing": dict(missing)}, indent=1) + "\n"
