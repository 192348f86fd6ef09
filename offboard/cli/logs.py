"""The commands that read a log: `offboard score`, `report`, `replay`, `export` and `identify`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import typer

from offboard.cli.fly import fly
from offboard.cli.shared import (
    FLIGHT,
    FLIGHTS,
    Directory,
    Requirements,
    SitlOptions,
    absent,
    err,
    keep,
    out,
    say,
    scored,
    write,
    write_new,
)
from offboard.documents.arguments import option
from offboard.documents.command_line import complain
from offboard.documents.errors import UserError
from offboard.link.log import free_name

OUTPUT = ("-o", "--output")  # names of the option
PAGE = "report.html"


def score(
    flight: Annotated[Path, FLIGHT],
    as_json: Annotated[bool, typer.Option("--json", help="Print the score as JSON.")] = False,
    require: Requirements = None,
) -> None:
    """Score a flight from its .tlog alone.

    Prints whether the flight was completed, what happened in the order of time, then every metric.
    Every requirement on a flight that was not completed is missed. Writes score.json if FLIGHT is a
    directory.

    Exit codes: 0 scored and all requirements met; 1 a requirement missed; 2 usage error, or the
    log cannot be read.
    """
    from offboard.analysis.score import Requirement, as_text
    from offboard.analysis.score_table import show, verdict

    requirements = [Requirement.parse(text) for text in require or ()]
    result, history = scored(flight)
    if as_json:
        write(as_text(result, history))
    else:
        show(out, result, history)
    if history.unread:
        complain(history.unread)
    metrics = result.metrics()
    missed = [each.sentence(metrics) for each in requirements if not each.met(metrics)]
    if requirements and result.completed != 1.0:
        missed.insert(0, verdict(result))
    if missed:
        raise UserError("; ".join(missed), 1)


def report(
    flights: Annotated[
        list[Path],
        typer.Argument(metavar="FLIGHT...", help="Flight directories or .tlog files, of anybody."),
    ],
    output: Annotated[
        Path | None,
        option("FILE", f"Page.  [default: {PAGE} beside the first log]", *OUTPUT, callback=absent),
    ] = None,
) -> None:
    """Show flights on one HTML page, from their .tlog alone.

    Verdict, path, errors, attitude, thrust, decisions, link and identification over one time axis.
    Several flights are drawn over each other, with a table of their metrics side by side. A log of
    another program gives what it holds; the page says what is missing or damaged. A flight
    directory without score.json gets one.

    Exit codes: 0 done; 2 usage error, or a file that cannot be read or written.
    """
    from offboard.analysis import tlog
    from offboard.report.flight import read
    from offboard.report.report_page import page

    path = output or free_name(tlog.find(flights[0]).with_name(PAGE))
    shown = [read(flight) for flight in flights]
    for place, flight in zip(flights, shown, strict=True):
        if not (place / "score.json").exists():
            keep(place, flight.score, flight.history)
    write_new(path, page(shown))
    say(f"written: {path}", indent=2)


def replay(flight: Annotated[Path, FLIGHT]) -> None:
    """Replay a flight from its .tlog and compare every setpoint.

    Gives the controller what it received, turn by turn, and compares what it sends now with what
    it sent then, byte by byte; rounding of another processor is named, and is no difference.
    Prints the first difference, and the messages before it. Flights of `offboard daemon` cannot be
    replayed: their logs do not hold what was received in standby.

    Exit codes: 0 all identical, or rounded differently by another computer; 1 a setpoint or a
    command differs; 2 the log cannot be replayed, or there is nothing to compare.
    """
    from offboard.replay.difference import explained, verdict
    from offboard.replay.replaying import Replay, read

    recording = read(flight)
    if recording.log.unread:
        complain(recording.log.unread)
    replayed = Replay(recording)
    with err.status("replaying") as status:
        comparison = verdict(replayed, status.update)
    if replayed.incomplete:
        complain(replayed.incomplete)
    sentence = comparison.sentence()
    if not comparison.significant:
        say(f"{sentence} ({replayed.count} turns, up to {replayed.ended_s:.1f} s of vehicle time)")
        return
    say("the first difference:")
    for line in explained(recording, comparison.significant[0]):
        say(f"  {line}", indent=6)
    raise UserError(sentence, 1)


def export(
    flight: Annotated[Path, FLIGHT],
    to: Annotated[Literal["mcap", "csv", "ulog"], option("FORMAT", "mcap, csv or ulog.", "--to")],
    output: Annotated[Path, option("FILE", "File to write, a new one.", *OUTPUT, callback=absent)],
) -> None:
    """Write a flight in the format of another tool.

    mcap: Foxglove's schemas (ENU) and all values as JSON, for Foxglove, Lichtblick, Rerun and
    PlotJuggler, in vehicle time from the Unix time of the first telemetry. ulog: PX4's topics, for
    PlotJuggler and pyulog, in vehicle time. csv: one row for each sample, with both times, units in
    the names of the columns. UAV Log Viewer and MAVExplorer read the .tlog itself. mcap needs the
    extra `export`.

    Exit codes: 0 done; 2 usage error, or a file that cannot be read or written.
    """
    from offboard.export.mcap_file import write_mcap
    from offboard.export.series import events_of, read, series_of, write_csv
    from offboard.export.ulog import write_ulog

    found = read(flight)
    write = {"mcap": write_mcap, "csv": write_csv, "ulog": write_ulog}[to]
    write(found, output)
    if found.unread:
        complain(found.unread)
    held = ", ".join(f"{len(rows)} of {name}" for name, rows in series_of(found).items())
    say(f"{output}: samples: {held}; {len(events_of(found))} events")


def identify(
    options: SitlOptions,
    flight: Annotated[Path | None, FLIGHT] = None,
    output: Annotated[
        Path | None, option("FILE", "Vehicle file to write.", *OUTPUT, callback=absent)
    ] = None,
    out_directory: Directory = None,
) -> None:
    """Identify a vehicle from a flight: vehicle file and report.

    Identifies delay, attitude response, hover thrust, thrust lag and drag, each with its standard
    deviation. Prints the vehicle file; -o writes it. The report, identify.html beside it or beside
    the log, shows the fits. What is not identified is taken from --vehicle, or from the flight.

    With --connect or --sitl the reference `identify`, or another one, is flown first, as by
    `offboard fly`.

    Exit codes: 0 identified; 1 nothing could be identified; 2 usage or configuration error, or
    the log cannot be read. If the flight with --connect or --sitl fails: those of `offboard
    fly`.
    """
    from offboard.analysis import tlog
    from offboard.analysis.identify import identify_flight, vehicle_file
    from offboard.link import clock
    from offboard.report.fits import fits
    from offboard.report.flight import read
    from offboard.report.report_page import page
    from offboard.run.configuration import flown

    if (flight is None) == (options.connect is None and not options.sitl):
        raise UserError("name a FLIGHT, or fly one first with --connect or --sitl; not both")
    if flight is None:
        flight = out_directory or FLIGHTS / f"identify-{clock.local_stamp()}"
        along = replace(options, reference=options.reference or "identify")
        fly(along, out_directory=flight, report=False)
    elif out_directory or options != SitlOptions(vehicle=options.vehicle):
        raise UserError(
            "a log needs no --system, --out or other options of a flight; --vehicle may be given"
        )
    recorded = read(flight)
    known = None if options.vehicle else recorded.configuration
    prior = (flown(known) if known is not None else options.load()).vehicle
    if recorded.history.unread:
        complain(recorded.history.unread)
    found, trace = identify_flight(recorded.history, prior)
    named = prior.model_copy(update={"name": output.stem[:40] if output else "identified"})
    text = vehicle_file(found, named, recorded.name)
    shown = free_name((output or tlog.find(flight)).with_name("identify.html"))
    write_new(shown, page([recorded], fits(found, trace, prior)))
    if not found.supported:
        raise UserError(f"nothing could be identified from this flight; {shown} says why", 1)
    if output is not None:
        write_new(output, text)
    out.print(text, end="", markup=False, soft_wrap=True)
    written = f"{output} and {shown}" if output else f"{shown}; -o FILE writes the vehicle file"
    say(f"written: {written}", indent=2)
