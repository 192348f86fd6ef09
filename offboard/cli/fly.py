"""`offboard fly`: one flight, printed while it happens, and its result in ten lines."""

from __future__ import annotations

import os
import sys
from contextlib import closing, nullcontext
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
from offboard.documents.command_line import drop_output, explained

if TYPE_CHECKING:
    from offboard.analysis.requirement import Requirement
    from offboard.flight.companion import Companion, Outcome

INTERRUPTED = "interrupted before anything was sent"
LABEL_WIDTH = 15
LINES_MAX = 1000  # that wait for the terminal
TERMINAL_S = 2.0  # for them, after the flight
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
    if sitl and connect:
        raise CommandError("--sitl starts its own simulator: use --sitl or --connect, not both")
    if not sitl and (scenario or sim_vehicle or firmware != "px4"):
        raise CommandError("--scenario, --sim-vehicle and --firmware are options of --sitl: add it")
    named = {"controller": controller, "reference": reference, "vehicle": vehicle}
    try:
        from offboard.flight.sitl import SimulatorProcess
        from offboard.flight.stop import StopRequests

        with (
            StopRequests(_exit_at_once) as stops,
            SimulatorProcess() if sitl else nullcontext() as simulator,  # loads in the background
            closing(_Announcer()) as announcer,
        ):
            from offboard.compiled import loading

            with loading():
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
            outcome = fly_request(request, announcer.announce, say, simulator, stops)
    except KeyboardInterrupt:  # before the flight; in flight an interrupt lands the vehicle
        raise CommandError(INTERRUPTED) from None
    if outcome.exit_code == 2:
        raise CommandError(outcome.sentence)
    _conclude(outcome, directory, requirements, announcer.dropped)


def _exit_at_once() -> None:
    """Exit although code may be compiling; the simulator ends when the pipe to it closes."""
    os.write(2, f"{INTERRUPTED}\n".encode())
    os._exit(2)


class _Announcer:
    """Prints what the companion has announced. It does not wait for the terminal, which Ctrl-S
    stops: `dropped` lines did not fit into the queue, or were not taken until `close`."""

    def __init__(self) -> None:
        from offboard.flight.background import BackgroundWriter

        self._writer = BackgroundWriter[str](_show, LINES_MAX)
        self._shown = 0

    def announce(self, companion: Companion) -> None:
        for line in companion.announced[self._shown :]:
            self._writer.put(f"{companion.state.time_s:8.2f} s  {line}")
        self._shown = len(companion.announced)

    def close(self) -> None:
        self._writer.close(TERMINAL_S)

    @property
    def dropped(self) -> int:
        return 0 if self._writer.error else self._writer.dropped  # nobody misses a closed pipe


def _show(lines: list[str]) -> None:
    for line in lines:
        say(line, indent=12)


def _conclude(
    outcome: Outcome, directory: Path, requirements: list[Requirement], not_shown: int
) -> None:
    """Print verdict and result. Exits with the code of the verdict. `not_shown`: lines of the
    flight that the terminal did not take."""
    from offboard.analysis.score_table import summary
    from offboard.analysis.trial import judged

    score, history = scored(directory)
    outcome = judged(outcome, score)
    checked = [] if outcome.exit_code else requirements
    missed = [each for each in checked if not each.met(score.figures())]
    results = "; ".join(each.sentence(score.figures()) for each in missed or checked)
    code = outcome.exit_code or int(bool(missed))
    try:
        out.print()
        if not_shown:
            say(f"{not_shown} lines of the flight are missing above: the terminal was stopped")
        if outcome.exit_code:
            complain(f"{outcome.sentence} (log: {directory / 'flight.tlog'})")
        elif missed:
            complain(f"{outcome.sentence}; requirement missed: {results}")
        else:
            say(f"{outcome.sentence}{'; requirement met: ' if results else ''}{results}")
        for label, text in summary(score, history, directory):
            say(f"  {label:<{LABEL_WIDTH}}{text}", indent=2 + LABEL_WIDTH)
        sys.stdout.flush()
    except OSError as error:  # the exit code stays that of the flight
        drop_output()
        complain(f"{outcome.sentence}; {explained(error)}")
    if code:
        raise typer.Exit(code)
