"""`offboard identify`: the constants of a vehicle from a log, as a vehicle file and a page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from offboard.cli.fly import fly
from offboard.cli.shared import (
    FILE,
    FLIGHT,
    FLIGHTS,
    CommandError,
    Directory,
    SigningKey,
    System,
    check_new,
    complain,
    free_name,
    option,
    out,
    say,
    write_new,
)

EXIT_CODES = (
    "Exit codes: 0 identified; 1 nothing could be identified; 2 usage or configuration error, or "
    "the log cannot be read. If the flight with --connect or --sitl fails: those of `offboard fly`."
)


def identify(
    flight: Annotated[Path | None, FLIGHT] = None,
    output: Annotated[
        Path | None, option("FILE", "Vehicle file to write.", "-o", "--output")
    ] = None,
    page: Annotated[
        Path | None,
        option(
            "FILE", "Report of the flight with the fits.  [default: identify.html beside the log]"
        ),
    ] = None,
    connect: Annotated[
        str | None, option("LINK", "Fly the reference `identify` there and use its log.")
    ] = None,
    sitl: Annotated[
        bool, typer.Option("--sitl", help="The same on the bundled simulator.")
    ] = False,
    system: System = None,
    signing_key: SigningKey = None,
    vehicle: Annotated[
        str | None,
        option(FILE, "Source of constants that are not identified.  [default: the flight]"),
    ] = None,
    out_directory: Directory = None,
) -> None:
    """Identify a vehicle from a flight: vehicle file and report.

    Identifies delay, attitude response, hover thrust, thrust lag and drag, each with its standard
    deviation. Prints the vehicle file; -o writes it. The report shows the fits.
    """
    from offboard.analysis import history, tlog
    from offboard.analysis.identify import identify_flight, vehicle_file
    from offboard.link import clock
    from offboard.report.fits import fits
    from offboard.report.flight import read
    from offboard.report.report_page import page as report_page
    from offboard.run.configuration import flown, load

    if (flight is None) == (connect is None and not sitl):
        raise CommandError("name a FLIGHT, or fly one first with --connect or --sitl; not both")
    for chosen, name in ((output, "-o"), (page, "--page")):
        if chosen is not None:
            check_new(chosen, name)
    if output is not None and page is not None and output.resolve() == page.resolve():
        raise CommandError(f"-o and --page are both {output}; choose two files")
    if flight is not None and (system or signing_key or out_directory):
        raise CommandError(
            "a log needs no --system, --signing-key or --out: they are for --connect and --sitl"
        )
    if flight is None:
        flight = out_directory or FLIGHTS / f"identify-{clock.local_stamp()}"
        fly(
            sitl=sitl,
            connect=connect,
            system=system,
            signing_key=signing_key,
            reference="identify",
            vehicle=vehicle,
            out_directory=flight,
            report=False,
        )
    path = tlog.find(flight)
    log = tlog.read(path)
    configuration = history.configuration(log)
    if vehicle is None and configuration is not None:
        prior = flown(configuration).vehicle
    else:
        prior = load("flight", choices={"vehicle": vehicle}).vehicle
    recorded = read(flight)
    if recorded.history.damage:
        complain(recorded.history.damage)
    found, trace = identify_flight(recorded.sent, prior)
    name = flight.name or flight.resolve().name
    text = vehicle_file(found, prior, name)
    shown = page or free_name(path.with_name("identify.html"))
    write_new(shown, report_page([recorded], fits(found, trace, prior)))
    if not found.supported:
        raise CommandError(f"nothing could be identified from this flight; {shown} says why", 1)
    if output is not None:
        write_new(output, text)
    out.print(text, end="", markup=False, soft_wrap=True)
    written = f"{output} and {shown}" if output else f"{shown}; -o FILE writes the vehicle file"
    say(f"written: {written}", indent=2)
