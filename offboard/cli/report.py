"""`offboard report`: one flight, or several side by side, as an HTML page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from offboard.cli.score import keep
from offboard.cli.shared import check_new, free_name, option, say, write_new


def report(
    flights: Annotated[
        list[Path],
        typer.Argument(metavar="FLIGHT...", help="Flight directories or .tlog files, of anybody."),
    ],
    output: Annotated[
        Path | None,
        option("FILE", "Page.  [default: report.html beside the first log]", "-o", "--output"),
    ] = None,
) -> None:
    """Show flights on one HTML page, from their .tlog alone.

    Verdict, path, errors, attitude, thrust, decisions, link and identification over one time axis.
    Several flights are drawn over each other, with a table of their figures side by side. A log of
    another program gives what it holds; the page says what is missing or damaged. A flight
    directory without score.json gets one.
    """
    from offboard.analysis import tlog
    from offboard.report.flight import read
    from offboard.report.report_page import page

    if output is not None:
        check_new(output, "-o")
    path = output or free_name(tlog.find(flights[0]).with_name("report.html"))
    shown = [read(flight) for flight in flights]
    for place, flight in zip(flights, shown, strict=True):
        if not (place / "score.json").exists():
            keep(place, flight.score, flight.history)
    write_new(path, page(shown))
    say(f"written: {path}", indent=2)
