"""`offboard paper`: every table and figure of the study, written one after another, and their page.

The run is serial; each table and figure takes its flights from one `Flights`, which flies each
flight once. An interrupted run keeps the tables and figures that it has written.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from offboard.analysis.page import Figure, render
from offboard.documents.errors import UserError
from offboard.paper import errata, figures, horizon, tables
from offboard.paper.closed_loop import Flights
from offboard.paper.law import PaperSettings
from offboard.paper.printed import DOI
from offboard.paper.tables import Table, shown

PAGE = "paper.html"
TITLE = "Linear controller design with PSO for UAV trajectory tracking: printed and computed"
# Section of the page -> its tables and figures in reading order, and what makes each
SECTIONS: dict[str, dict[str, Callable[[Flights], Table | Figure]]] = {
    "Tables of the paper": {
        "table 2": tables.table_2, "figure gap": figures.gap_by_damping,
        "table 3": tables.table_3, "table 4": tables.table_4,
    },
    "Figures of the paper": {
        "figure 4": figures.search_motion, "figure 5": figures.reference_states,
        "figure 6": figures.reference_path,
        **{f"figure {number}": partial(figures.flown_figure, number) for number in figures.FLOWN},
    },
    "Errata, with computed evidence": {
        "table errata": errata.errata_table, "table bd": errata.bd_table,
    },
    "One step compared with longer horizons": {
        "table horizon": horizon.horizon_table, "figure horizon": horizon.horizon_figure,
        "figure laws": horizon.laws_figure, "table weights": horizon.weights_table,
    },
    "Extensions that the conclusions propose": {
        "table integral": tables.integral_table, "figure integral": figures.integral_figure,
        "table limits": tables.limits_table, "figure limits": figures.limits_figure,
    },
}  # fmt: skip
MAKERS = {label: make for pieces in SECTIONS.values() for label, make in pieces.items()}
SEEDS, QUICK_SEEDS, MOST_SEEDS = 20, 1, 10_000


@dataclass(frozen=True, slots=True)
class PaperOptions:
    """Options of `offboard paper`.

    Args:
        out: output directory; created if absent, else empty.
        quick: one seed, and the nonlinear plant of Table 2 at three lambdas only.
        seeds: flights per row of a table; None: 20, or 1 if quick.
        initial_q: diag(Q) of the first configuration (Eq. 23, whose values are not printed):
            twelve weights, or one for all; None: the identity.
        figures, tables: names as in "figure 4", "table bd"; both empty: everything.
    """

    out: Path
    quick: bool = False
    seeds: int | None = None
    initial_q: tuple[float, ...] | None = None
    figures: tuple[str, ...] = ()
    tables: tuple[str, ...] = ()

    @property
    def labels(self) -> tuple[str, ...]:
        """The tables and figures to make ("table 2", "figure gap"), tables first."""
        chosen = [f"table {name}" for name in self.tables]
        chosen += [f"figure {name}" for name in self.figures]
        return tuple(dict.fromkeys(chosen)) or (*known("table"), *known("figure"))

    def flights(self, on_flight: Callable[[], None] = lambda: None) -> Flights:
        """The flights of a run with these options."""
        first, diagonal = PaperSettings.first_configuration(), self.initial_q or (1.0,)
        diagonal = diagonal * 12 if len(diagonal) == 1 else diagonal
        seeds = (QUICK_SEEDS if self.quick else SEEDS) if self.seeds is None else self.seeds
        settings = first.model_copy(update={"fitness": diagonal})
        return Flights(settings, seeds, self.quick, on_flight)


def known(kind: str) -> list[str]:
    """The labels of all tables or figures."""
    return [label for label in MAKERS if label.startswith(kind)]


def check(options: PaperOptions) -> None:
    """Create the output directory. Raises UserError for the first option that is not valid."""
    for kind, names in (("figure", options.figures), ("table", options.tables)):
        for name in names:
            if f"{kind} {name}" not in MAKERS:
                all_names = ", ".join(label.split()[1] for label in known(kind))
                raise UserError(f"there is no {kind} {name!r}; known are {all_names}")
    if options.seeds is not None and not 1 <= options.seeds <= MOST_SEEDS:
        raise UserError(f"seeds must be 1 .. {MOST_SEEDS}, not {options.seeds}")
    diagonal = options.initial_q or (1.0,)
    if len(diagonal) not in (1, 12):
        raise UserError(f"the initial Q takes 1 or 12 weights, not {len(diagonal)}")
    for weight in diagonal:
        if not (math.isfinite(weight) and weight >= 0):
            raise UserError(f"the weights of the initial Q must be 0 or more, not {weight:g}")
    options.out.mkdir(parents=True, exist_ok=True)
    if any(options.out.iterdir()):
        raise UserError(f"{options.out} is not empty; choose another directory with --out")


def reproduce(options: PaperOptions, console: Console | None = None) -> dict[str, Table | Figure]:
    """Compute and write everything that `options` ask for, with progress on `console` (stderr).

    Writes table_NAME.csv and .json, figure_NAME.json, run.json and paper.html to `options.out`.
    Returns tables and figures by label. Raises UserError for invalid options or an output that
    cannot be written.
    """
    try:
        check(options)
        return _reproduce(options, console or Console(stderr=True))
    except OSError as error:
        sentence = f"{options.out} cannot be written: {error.strerror or error}"
        raise UserError(sentence) from None


def _reproduce(options: PaperOptions, console: Console) -> dict[str, Table | Figure]:
    made: dict[str, Table | Figure] = {}
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    progress = Progress(*columns, TimeElapsedColumn(), console=console)
    bar = progress.add_task("paper", total=len(options.labels))
    count = 0

    def on_flight() -> None:
        nonlocal count
        count += 1
        progress.update(bar, description=f"{label}: flight {count}")

    flights = options.flights(on_flight)
    with progress:
        for label in options.labels:
            progress.update(bar, description=label)
            made[label] = piece = MAKERS[label](flights)
            stem = options.out / label.replace(" ", "_")
            stem.with_suffix(".json").write_text(piece.to_json(), encoding="utf-8")
            if isinstance(piece, Table):
                stem.with_suffix(".csv").write_text(piece.to_csv(), encoding="utf-8")
            progress.advance(bar)
    facts = {
        "pso-offboard": metadata.version("pso-offboard"),
        "seeds per row": str(flights.seeds),
        "quick": "yes" if options.quick else "no",
        "diag Q of the first configuration": ", ".join(f"{q:g}" for q in flights.first.fitness),
    }
    (options.out / PAGE).write_text(page(made, facts), encoding="utf-8")
    document = json.dumps({"run": facts}, indent=1) + "\n"
    (options.out / "run.json").write_text(document, encoding="utf-8")
    return made


def page(made: Mapping[str, Table | Figure], facts: Mapping[str, str]) -> str:
    """The page as text: tables and figures by label, and what describes the run."""
    sections = {
        title: {label: made[label] for label in pieces if label in made}
        for title, pieces in SECTIONS.items()
    }
    return render(
        "paper/page.html",
        title=TITLE,
        doi=DOI,
        facts=facts,
        sections={title: pieces for title, pieces in sections.items() if pieces},
        shown=shown,
    )
