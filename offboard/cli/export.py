"""`offboard export`: a flight in the format of another tool."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

from offboard.cli.shared import FLIGHT, check_new, complain, option, say


class Format(str, Enum):  # noqa: UP042 - typer shows the values of a `str`
    MCAP = "mcap"
    CSV = "csv"
    ULOG = "ulog"


def export(
    flight: Annotated[Path, FLIGHT],
    to: Annotated[Format, option("FORMAT", "mcap, csv or ulog.", "--to")],
    output: Annotated[Path, option("FILE", "File to write, a new one.", "-o", "--output")],
) -> None:
    """Write a flight in the format of another tool.

    mcap: Foxglove's schemas (ENU) and all values as JSON, for Foxglove, Lichtblick, Rerun and
    PlotJuggler, in vehicle time from the Unix time of the first telemetry. ulog: PX4's topics, for
    PlotJuggler and pyulog, in vehicle time. csv: one row for each sample, with both times, units in
    the names of the columns. UAV Log Viewer and MAVExplorer read the .tlog itself. mcap needs the
    extra `export`.
    """
    from offboard.export.mcap_file import write_mcap
    from offboard.export.series import read
    from offboard.export.table import write_csv
    from offboard.export.ulog import write_ulog

    check_new(output, "-o")
    found = read(flight)
    write = {Format.MCAP: write_mcap, Format.CSV: write_csv, Format.ULOG: write_ulog}[to]
    write(found, output)
    if found.damage:
        complain(found.damage)
    held = ", ".join(f"{len(each.time_s)} of {name}" for name, each in found.series.items())
    say(f"{output}: samples: {held}; {len(found.events)} events")
