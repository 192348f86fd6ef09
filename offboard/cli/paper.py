"""`offboard paper`: the tables and figures of the paper, ours beside theirs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from offboard.cli.shared import FLIGHTS, CommandError, err, say


def paper(
    out_directory: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="DIR",
            help="Directory of page, tables and figures.  [default: a new one]",
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer seeds: seconds instead of minutes.")
    ] = False,
    seeds: Annotated[
        int | None, typer.Option(metavar="N", help="Flights per row.  [default: 20]")
    ] = None,
    initial_q: Annotated[
        str | None,
        typer.Option(metavar="LIST", help="diag(Q) of Eq. 23: 1 or 12 comma-separated weights."),
    ] = None,
    figure: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Only this figure; repeatable.")
    ] = None,
    table: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Only this table; repeatable.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(metavar="N", help="Processes.  [default: one per processor]")
    ] = None,
) -> None:
    """Reproduce tables 2-4 and figures 4-17 of the paper on one page."""
    from offboard.flight import clock
    from offboard.paper.study.options import PaperOptions
    from offboard.paper.study.run import reproduce

    try:
        weights = None if initial_q is None else tuple(float(w) for w in initial_q.split(","))
    except ValueError:
        raise CommandError(
            f"--initial-q {initial_q}: 1 or 12 numbers with commas between"
        ) from None
    options = PaperOptions(
        out=out_directory or FLIGHTS / f"paper-{clock.local_stamp()}",
        quick=quick,
        seeds=seeds,
        initial_q=weights,
        figures=tuple(figure or ()),
        tables=tuple(table or ()),
        workers=workers,
    )
    outcome = reproduce(options, err)
    say(f"written: {outcome.page}", indent=2)
    if outcome.missing:
        parts = "; ".join(f"{label}: {why}" for label, why in outcome.missing.items())
        raise CommandError(f"missing: {parts}", 1)
