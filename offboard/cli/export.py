"""`offboard export`: a flight in the format of another tool."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from offboard.cli.shared import FLIGHT, check_new, complain, option, say
from offboard.documents.errors import UserError


class Format(str, Enum):  # noqa: UP042 - typer shows the values of a `str`
    MCAP = "mcap"
    CSV = "csv"
    ULOG = "ulog"


def export(
    flight: Annotated[Path, FLIGHT],
    to: Annotated[Format, option("FORMAT", "mcap, csv or ulog.", "--to")],
    output: Annotated[Path, option("FILE", "File to write, a new one.", "-o", "--output")],
    vehicle_time: Annotated[
        bool,
        typer.Option(
            "--vehicle-time",
            help="mcap: seconds since the vehicle's start, not Unix time; always of a lockstep "
            "flight.",
        ),
    ] = False,
) -> None:
    """Write a flight in the format of another tool.

    mcap: Foxglove's schemas (ENU) and all values as JSON, for Foxglove, Lichtblick, Rerun and
    PlotJuggler. ulog: PX4's topics, for PlotJuggler and pyulog; its stamps are always vehicle time.
    csv: one row for each sample, with both times, units in the names of the columns. UAV
    Log Viewer and MAVExplorer read the .tlog itself. mcap needs the extra `export`.
    """
    if vehicle_time and to is not Format.MCAP:
        raise UserError(f"--vehicle-time is an option of --to mcap: {to.value} always has it")
    from offboard.export.mcap_file import write_mcap
    from offboard.export.series import read
    from offboard.export.table import write_csv
    from offboard.export.ulog import write_ulog

    check_new(output, "-o")
    found = read(flight)
    if to is Format.MCAP:
        write_mcap(found, output, vehicle_time=vehicle_time or not found.in_real_time)
    else:
        write = {Format.CSV: write_csv, Format.ULOG: write_ulog}[to]
        write(found, output)
    if found.damage:
        complain(found.damage)
    held = ", ".join(f"{len(each.time_s)} of {name}" for name, each in found.series.items())
    say(f"{output}: samples: {held}; {len(found.events)} events")
