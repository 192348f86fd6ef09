"""`offboard paper`: the tables and figures of the paper, with ours beside them."""

from __future__ import annotations

from typing import Annotated

import typer

from offboard.cli.shared import FLIGHTS, Directory, err, say
from offboard.documents.arguments import option
from offboard.documents.errors import UserError


def paper(
    out_directory: Directory = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="One seed; less than a minute instead of several.")
    ] = False,
    seeds: Annotated[
        int | None, option("N", "Flights per row.  [default: 20]", min=1, max=10_000)
    ] = None,
    figure: Annotated[list[str] | None, option("NAME", "Only this figure; repeatable.")] = None,
    table: Annotated[list[str] | None, option("NAME", "Only this table; repeatable.")] = None,
) -> None:
    """Reproduce tables 2-4 and figures 4-17 of the paper on one page.

    Exit codes: 0 all written; 2 usage error.
    """
    if quick and seeds is not None:
        raise UserError("--quick is --seeds 1: use one of them")
    from offboard.link import clock
    from offboard.paper.study import PAGE, SEEDS, reproduce

    directory = out_directory or FLIGHTS / f"paper-{clock.local_stamp()}"
    labels = [f"table {name}" for name in table or ()]
    labels += [f"figure {name}" for name in figure or ()]
    flights = (1 if quick else SEEDS) if seeds is None else seeds
    reproduce(directory, labels, flights, err)
    say(f"written: {directory / PAGE}", indent=2)
