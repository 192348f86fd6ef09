"""`offboard fly`: one flight, printed while it happens, and its result in ten lines."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from offboard.cli.score import requirements_of, scored
from offboard.cli.shared import (
    DEFAULT_CONNECTION,
    FILE,
    FLIGHTS,
    Assignments,
    CommandError,
    Directory,
    Requirements,
    Vehicle,
    complain,
    option,
    out,
    say,
)

if TYPE_CHECKING:
    from offboard.analysis.requirement import Requirement
    from offboard.flight.companion import Companion, Outcome

INTERRUPTED = "interrupted before anything was sent"
LABEL_WIDTH = 15
LINKS = (
    "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD.  "
    f"[default: {DEFAULT_CONNECTION}]"
)


def fly(
    sitl: Annotated[bool, typer.Option("--sitl", help="Fly the bundled simulator.")] = False,
    connect: Annotated[str | None, option("LINK", LINKS)] = None,
    config: Annotated[str, option(FILE, "Configuration.")] = "flight",
    controller: Annotated[str | None, option(FILE, "Controller.")] = None,
    reference: Annotated[str | None, option(FILE, "Reference; a file may also be .csv.")] = None,
    vehicle: Vehicle = None,
    firmware: Annotated[str, option("NAME", "With --sitl: px4 or ardupilot.")] = "px4",
    scenario: Annotated[
        str | None, option(FILE, "With --sitl: scenario.  [default: errors of the firmware]")
    ] = None,
    sim_vehicle: Annotated[
        str | None, option(FILE, "With --sitl: simulated vehicle; may differ from --vehicle.")
    ] = None,
    seed: Annotated[int | None, option("N", "Random seed, also of the simulator.")] = None,
    out_directory: Directory = None,
    require: Requirements = None,
    assignments: Assignments = None,
) -> None:
    """Fly a reference: connect, arm, take off, track, land, score.

    Prints the phases of the flight as they happen and ends with the result. The flight directory
    holds flight.tlog (all messages), flight.yaml (the resolved configuration) and score.json.
    NAME is the name of a shipped file, see below and `offboard list`.
    """
    from offboard.flight.sitl import SimulatorProcess
    from offboard.flight.stop import StopRequests

    if sitl and connect:
        raise CommandError("--sitl starts its own simulator: use --sitl or --connect, not both")
    if not sitl and (scenario or sim_vehicle or firmware != "px4"):
        raise CommandError("--scenario, --sim-vehicle and --firmware are options of --sitl: add it")
    named = {"controller": controller, "reference": reference, "vehicle": vehicle}
    try:
        with (
            StopRequests(_exit_at_once) as stops,
            SimulatorProcess() if sitl else nullcontext() as simulator,  # loads in the background
        ):
            from offboard.flight import clock
            from offboard.flight.request import FlightRequest, fly_request

            requirements = requirements_of(require)
            directory = out_directory or FLIGHTS / clock.local_stamp()
            request = FlightRequest(
                directory=directory,
                config=config,
                choices={part: name for part, name in named.items() if name is not None},
                assignments=tuple(assignments or ()),
                seed=seed,
                connection=connect or DEFAULT_CONNECTION,
                sitl=sitl,
                firmware=firmware,
                scenario=scenario,
                sim_vehicle=sim_vehicle,
            )
            outcome = fly_request(request, _announcer(), say, simulator, stops)
    except KeyboardInterrupt:  # before the flight; in flight an interrupt lands the vehicle
        raise CommandError(INTERRUPTED) from None
    if outcome.exit_code == 2:
        raise CommandError(outcome.sentence)
    _conclude(outcome, directory, requirements)


def _exit_at_once() -> None:
    """Exit although code may be compiling; the simulator ends when the pipe to it closes."""
    os.write(2, f"{INTERRUPTED}\n".encode())
    os._exit(2)


def _announcer() -> Callable[[Companion], None]:
    """A function that prints what the companion has announced since the last call."""
    shown = 0

    def announce(companion: Companion) -> None:
        nonlocal shown
        for line in companion.announced[shown:]:
            say(f"{companion.state.time_s:8.2f} s  {line}", indent=12)
        shown = len(companion.announced)

    return announce


def _conclude(outcome: Outcome, directory: Path, requirements: list[Requirement]) -> None:
    """Print verdict and result. Exits with the code of the verdict."""
    from offboard.analysis.score_table import summary
    from offboard.analysis.trial import judged

    score, history = scored(directory)
    outcome = judged(outcome, score)
    checked = [] if outcome.exit_code else requirements
    missed = [each for each in checked if not each.met(score.figures())]
    results = "; ".join(each.sentence(score.figures()) for each in missed or checked)
    code = outcome.exit_code or int(bool(missed))
    out.print()
    if outcome.exit_code:
        complain(f"{outcome.sentence} (log: {directory / 'flight.tlog'})")
    elif missed:
        complain(f"{outcome.sentence}; requirement missed: {results}")
    else:
        say(f"{outcome.sentence}{'; requirement met: ' if results else ''}{results}")
    for label, text in summary(score, history, directory):
        say(f"  {label:<{LABEL_WIDTH}}{text}", indent=2 + LABEL_WIDTH)
    if code:
        raise typer.Exit(code)
