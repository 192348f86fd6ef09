"""`offboard paper`: the tables and figures of the paper, ours beside theirs."""

from __future__ import annotations

from typing import Annotated

import typer

from offboard.cli.shared import FLIGHTS, Directory, err, option, say
from offboard.documents.errors import UserError

EXIT_CODES = "Exit codes: 0 all written; 2 usage error."


def paper(
    out_directory: Directory = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="One seed; less than a minute instead of several.")
    ] = False,
    seeds: Annotated[int | None, option("N", "Flights per row.  [default: 20]")] = None,
    initial_q: Annotated[
        str | None, option("LIST", "diag(Q) of Eq. 23: 1 or 12 weights, separated by commas.")
    ] = None,
    figure: Annotated[list[str] | None, option("NAME", "Only this figure; repeatable.")] = None,
    table: Annotated[list[str] | None, option("NAME", "Only this table; repeatable.")] = None,
) -> None:
    """Reproduce tables 2-4 and figures 4-17 of the paper on one page."""
    from offboard.link import clock
    from offboard.paper.study import PAGE, PaperOptions, reproduce

    try:
        weights = None if initial_q is None else tuple(float(w) for w in initial_q.split(","))
    except ValueError:
        raise UserError(f"--initial-q {initial_q}: 1 or 12 numbers with commas between") from None
    options = PaperOptions(
        out=out_directory or FLIGHTS / f"paper-{clock.local_stamp()}",
        quick=quick,
        seeds=seeds,
        initial_q=weights,
        figures=tuple(figure or ()),
        tables=tuple(table or ()),
    )
    reproduce(options, err)
    say(f"written: {options.out / PAGE}", indent=2)
