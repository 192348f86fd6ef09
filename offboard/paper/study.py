"""`offboard paper`: writes every table and figure of the study, one after another, and their page.

Each table and figure gets its flights from one `Flights`, which computes each flight once. An
interrupted run keeps the tables and figures that it has written.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib import metadata
from pathlib import Path

from rich.console import Console

from offboard.analysis.page import Figure, render
from offboard.documents.errors import UserError
from offboard.paper import extensions, figures, tables
from offboard.paper.closed_loop import Flights
from offboard.paper.printed import DOI
from offboard.paper.tables import Table, shown

PAGE = "paper.html"
TITLE = "Linear controller design with PSO for UAV trajectory tracking: printed and computed"
# Section of the page -> its tables and figures in reading order, and the function that makes each
SECTIONS: dict[str, dict[str, Callable[[Flights], Table | Figure]]] = {
    "Tables of the paper": {
        "table 2": tables.table_2, "table 3": tables.table_3, "table 4": tables.table_4,
    },
    "Figures of the paper": {
        "figure 4": figures.search_motion, "figure 5": figures.reference_states,
        "figure 6": figures.reference_path,
        **{f"figure {number}": partial(figures.flown_figure, number) for number in figures.FLOWN},
    },
    "Errata, with computed evidence": {"table errata": tables.errata_table},
    "One step compared with longer horizons": {
        "table horizon": extensions.horizon_table, "figure laws": extensions.laws_figure,
    },
    "Extensions that the conclusions propose": {
        "table integral": extensions.integral_table, "table limits": extensions.limits_table,
    },
}  # fmt: skip
MAKERS = {label: make for pieces in SECTIONS.values() for label, make in pieces.items()}
SEEDS = 20


def reproduce(
    out: Path, labels: Sequence[str], seeds: int, console: Console
) -> dict[str, Table | Figure]:
    """Compute and write tables and figures, with progress on `console` (stderr).

    Args:
        out: output directory; created if absent, else empty.
        labels: tables and figures to make, such as "table 2" or "figure laws"; empty: all.
        seeds: flights per row of a table.

    Writes table_NAME.csv, figure_NAME.json and paper.html to `out`. Returns tables and figures by
    label. Raises UserError for invalid arguments or an output that cannot be written.
    """
    for label in labels:
        kind, _, name = label.partition(" ")
        if label not in MAKERS:
            known = [each.removeprefix(f"{kind} ") for each in MAKERS if each.startswith(kind)]
            raise UserError(f"there is no {kind} {name!r}; known are {', '.join(known)}")
    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            raise UserError(f"{out} is not empty; choose another directory with --out")
    except OSError as error:
        raise UserError(f"{out} cannot be written: {error.strerror or error}") from None
    labels = list(dict.fromkeys(labels)) or sorted(MAKERS, key=lambda label: label[0] == "f")
    made: dict[str, Table | Figure] = {}
    with console.status("") as status:
        flights = Flights(
            seeds,
            lambda flown: status.update(
                f"{len(made)} of {len(labels)} are made; {label}: flight {flown}"
            ),
        )
        for label in labels:
            made[label] = piece = MAKERS[label](flights)
            text, end = (
                (piece.to_csv(), "csv") if isinstance(piece, Table) else (piece.to_json(), "json")
            )
            (out / f"{label.replace(' ', '_')}.{end}").write_text(text, encoding="utf-8")
    facts = {"pso-offboard": metadata.version("pso-offboard"), "seeds per row": str(seeds)}
    sections = {
        title: found
        for title, pieces in SECTIONS.items()
        if (found := {label: made[label] for label in pieces if label in made})
    }
    page = render(
        "paper/page.html",
        title=TITLE,
        doi=DOI,
        facts=facts,
        sections=sections,
        shown=shown,
    )
    (out / PAGE).write_text(page, encoding="utf-8")
    return made
