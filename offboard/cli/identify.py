"""`offboard identify`: the constants of a vehicle from a log, as a vehicle file and a page."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from offboard.cli.fly import fly
from offboard.cli.shared import (
    FLIGHT,
    FLIGHTS,
    Directory,
    FlightOptions,
    SimulatorOptions,
    check_new,
    complain,
    free_name,
    grouped,
    option,
    out,
    say,
    write_new,
)
from offboard.documents.errors import UserError

EXIT_CODES = (
    "Exit codes: 0 identified; 1 nothing could be identified; 2 usage or configuration error, or "
    "the log cannot be read. If the flight with --connect or --sitl fails: those of `offboard fly`."
)


@grouped
def identify(
    options: FlightOptions,
    simulated: SimulatorOptions,
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
    out_directory: Directory = None,
) -> None:
    """Identify a vehicle from a flight: vehicle file and report.

    Identifies delay, attitude response, hover thrust, thrust lag and drag, each with its standard
    deviation. Prints the vehicle file; -o writes it. The report shows the fits. What is not
    identified is taken from --vehicle, or from the flight.

    With --connect or --sitl the reference `identify`, or another one, is flown first, as by
    `offboard fly`.
    """
    from offboard.analysis import history, tlog
    from offboard.analysis.identify import identify_flight, vehicle_file
    from offboard.link import clock
    from offboard.report.fits import fits
    from offboard.report.flight import read
    from offboard.report.report_page import page as report_page
    from offboard.run.configuration import flown

    if (flight is None) == (options.connect is None and not simulated.sitl):
        raise UserError("name a FLIGHT, or fly one first with --connect or --sitl; not both")
    for chosen, name in ((output, "-o"), (page, "--page")):
        if chosen is not None:
            check_new(chosen, name)
    if output is not None and page is not None and output.resolve() == page.resolve():
        raise UserError(f"-o and --page are both {output}; choose two files")
    if flight is None:
        flight = out_directory or FLIGHTS / f"identify-{clock.local_stamp()}"
        reference = options.reference or "identify"
        given = asdict(options) | asdict(simulated) | {"reference": reference}
        fly(**given, out_directory=flight, report=False)
    elif out_directory or (options, simulated) != (
        FlightOptions(vehicle=options.vehicle), SimulatorOptions()
    ):  # fmt: skip
        raise UserError(
            "a log needs no --system, --out or other options of a flight; --vehicle may be given"
        )
    path = tlog.find(flight)
    log = tlog.read(path)
    configuration = history.configuration(log)
    if options.vehicle is None and configuration is not None:
        prior = flown(configuration).vehicle
    else:
        prior = options.load().vehicle
    recorded = read(flight)
    if recorded.history.damage:
        complain(recorded.history.damage)
    found, trace = identify_flight(recorded.sent, prior)
    name = flight.name or flight.resolve().name
    text = vehicle_file(found, prior, name)
    shown = page or free_name(path.with_name("identify.html"))
    write_new(shown, report_page([recorded], fits(found, trace, prior)))
    if not found.supported:
        raise UserError(f"nothing could be identified from this flight; {shown} says why", 1)
    if output is not None:
        write_new(output, text)
    out.print(text, end="", markup=False, soft_wrap=True)
    written = f"{output} and {shown}" if output else f"{shown}; -o FILE writes the vehicle file"
    say(f"written: {written}", indent=2)
