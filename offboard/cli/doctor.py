"""`offboard doctor`: checks a vehicle, its link and this computer before a flight."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from offboard.cli.shared import (
    FLIGHTS,
    REFUSED,
    FlightOptions,
    err,
    out,
    say,
    say_each,
    write,
)
from offboard.documents.arguments import option


def doctor(
    options: FlightOptions,
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="CHECK...", help="Only these checks.  [default: all]"),
    ] = None,
    out_directory: Annotated[
        Path | None, option("DIR", "Where flights are recorded.  [default: flights]", "--out")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
    listing: Annotated[bool, typer.Option("--list", help="List the checks and exit.")] = False,
) -> None:
    """Check vehicle, link and computer before a flight.

    Listens for 4 to 9 s, and ends within 15 s: what takes longer is a row. Sends TIMESYNC and
    requests: for parameters, for single messages, for the telemetry rates of a flight, and that the
    vehicle runs its pre-arm checks. It never sends a heartbeat or a setpoint, arms, selects a mode
    or sets a parameter. Of an armed vehicle it requests no rates.

    Levels: ok; warn; wait, which may clear by itself; blocks, which `offboard fly` refuses, too.

    Exit codes: 0 nothing blocks a flight; 2 usage or configuration error; 3 something blocks.
    """
    from offboard.doctor import run
    from offboard.flight.preflight import Level

    chosen = run.chosen(names or ())
    if listing:
        say_each({name: run.summary(check) for name, check in chosen.items()}, margin=0)
        return
    flight = options.load()
    with err.status("opening the link") as status:  # a line on a terminal, nothing elsewhere
        seen = run.observe(
            options.connection(), flight, out_directory or FLIGHTS, tell=status.update
        )
        status.update("judging")
        rows = run.examine(chosen, seen)
    sentence = run.verdict(rows, complete=not names)
    if as_json:
        write(run.as_json(rows, seen, sentence))
    else:
        levels = max(map(len, Level.__members__))
        width = max(map(len, rows), default=0)
        indent = levels + width + 4
        for check, findings in rows.items():
            # findings that are ok are printed only if the check has no others, and only the first
            for finding in [f for f in findings if f.level is not Level.OK] or findings[:1]:
                level = finding.level.name.lower()
                say(f"{level:<{levels}}  {check:<{width}}  {finding.found}", indent)
                if finding.hint:
                    say(f"{'':<{indent}}fix: {finding.hint}", indent + 5)
        out.print()
        say(sentence)
    if run.worst(rows) is Level.BLOCKS:
        raise typer.Exit(REFUSED)
