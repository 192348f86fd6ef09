"""`offboard fly`: one flight, printed while it happens, and its result in ten lines."""

from __future__ import annotations

import os
import shlex
import sys
from contextlib import closing, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from offboard.cli.shared import (
    FLIGHTS,
    Directory,
    FlightOptions,
    Report,
    Requirements,
    SimulatorOptions,
    grouped,
    option,
    out,
    requirements_of,
    say,
    scored,
    write,
)
from offboard.documents.arguments import LIVE_PAGE
from offboard.documents.command_line import INTERRUPT, complain, drop, explained
from offboard.documents.errors import UserError, plain

if TYPE_CHECKING:
    from offboard.analysis.score import Requirement
    from offboard.flight.flight import Outcome
    from offboard.live.process import Displays

INTERRUPTED = "interrupted before anything was sent"
LABEL_WIDTH = 15


@grouped
def fly(
    options: FlightOptions,
    simulated: SimulatorOptions,
    seed: Annotated[int | None, option("N", "Random seed, also of the simulator.")] = None,
    out_directory: Directory = None,
    require: Requirements = None,
    report: Report = True,
    live: Annotated[
        str | None,
        option("[HOST:PORT]", f"Show the flight on a page.  [without a value: {LIVE_PAGE}]"),
    ] = None,
    json_lines: Annotated[
        bool,
        typer.Option("--json-lines", help="One JSON object a line on stdout, for machines."),
    ] = False,
) -> None:
    """Fly a reference: connect, arm, take off, track, land, score.

    Prints the phases of the flight as they happen and ends with the result. The flight directory
    holds flight.tlog (all messages), flight.yaml (the resolved configuration), score.json, and
    some seconds later report.html.
    NAME is the name of a shipped file, see below and `offboard list`.

    With --json-lines stdout has nothing else. `type` of each object is preparation, announcement (a
    phase or another text), snapshot (once a second of vehicle time; SI, NED, null for what is not
    known) or, as the last one, result. What is refused before the log is created (wrong options or
    files, a link that does not open) has no result: it is a sentence on stderr, exit code 2 or 3.

    Exit codes: 0 flown and all requirements met; 1 a requirement missed, as all are if the log
    is gone; 2 usage or configuration error, nothing sent; 3 not flown: no vehicle or connection,
    refused, or stopped on the ground; 4 aborted in flight, or left armed; 130 interrupted before
    anything was sent; 141 nobody reads the output.
    """
    simulated.check(options)
    try:
        from offboard.link.stop import StopRequests
        from offboard.run.sitl import SimulatorProcess

        with (
            StopRequests(_exit_at_once) as stops,
            SimulatorProcess() if simulated.sitl else nullcontext() as simulator,
            closing(_displays(live, json_lines=json_lines)) as displays,
        ):
            from offboard.link import clock
            from offboard.run.flight import fly as fly_once

            requirements = requirements_of(require)
            directory = out_directory or FLIGHTS / clock.local_stamp()
            flown = simulated.vehicle(options)
            flight = options.load(seed, flown.known_vehicle)
            displays.begin(f"{directory.name}: {flight.reference.shape} by {flight.controller.law}")
            outcome = fly_once(
                flight,
                directory,
                flown,
                simulator=simulator,
                stops=stops,
                progress=displays.show,
                tell=displays.tell,
            )
            page = str(directory / "report.html") if report and not outcome.log_problem else ""
            displays.conclude(outcome.sentence, page)
    except KeyboardInterrupt:  # before the flight; in flight an interrupt lands the vehicle
        raise UserError(INTERRUPTED, INTERRUPT) from None
    if outcome.exit_code == 2:
        raise UserError(outcome.sentence)
    try:
        _conclude(outcome, directory, requirements, displays.lost, page=page, json_lines=json_lines)
    finally:
        if report:
            from offboard.link.after_flight import begin_report

            begin_report(directory)


def _exit_at_once() -> None:
    """Exit although code may be compiling; the simulator ends when the pipe to it closes."""
    os.write(2, f"{INTERRUPTED}\n".encode())
    os._exit(INTERRUPT)


def _displays(live: str | None, *, json_lines: bool) -> Displays:
    """What shows the flight: lines, and a server of the page at the address `live`."""
    from offboard.live.lines import JsonLines, Terminal
    from offboard.live.process import Displays, LiveProcess

    lines = JsonLines(write) if json_lines else Terminal(out, partial(say, indent=12))
    return Displays(lines, [LiveProcess("--live", live)] if live else [])


def _conclude(
    outcome: Outcome,
    directory: Path,
    requirements: list[Requirement],
    lost: list[str],
    *,
    page: str,
    json_lines: bool,
) -> None:
    """Print verdict and result. Exits with the code of the verdict, also if the log was deleted
    or replaced meanwhile; then every requirement is missed. `lost`: sentences on what was not shown
    of the flight. `page`: where the report will be, empty without one."""
    from offboard.analysis.score import Score, judged
    from offboard.analysis.score_table import summary
    from offboard.live.display import DIGITS, line

    rows: dict[str, str] = {}
    try:
        score, history = scored(directory)
    except (UserError, KeyboardInterrupt) as error:
        score = Score(ended_by=f"it cannot be scored: {str(error) or 'interrupted'}")
        outcome, page = replace(outcome, sentence=f"{outcome.sentence}; {score.ended_by}"), ""
    else:
        outcome, rows = judged(outcome, score), summary(score, history)
    checked = [] if outcome.exit_code else requirements
    missed = [each for each in checked if not each.met(score.metrics())]
    results = "; ".join(each.sentence(score.metrics()) for each in missed or checked)
    code = outcome.exit_code or int(bool(missed))
    try:
        if json_lines:
            write(
                line(
                    "result",
                    exit_code=code,
                    sentence=outcome.sentence,
                    requirements=results,
                    completed=score.completed == 1.0,
                    ended_by=score.ended_by,
                    directory=str(directory),
                    lost=lost,
                    figures=plain(score.metrics(), DIGITS),
                )
                + "\n"
            )
            raise typer.Exit(code)
        out.print()
        for sentence in lost:
            say(sentence)
        if outcome.exit_code:
            complain(f"{outcome.sentence} (log: {directory / 'flight.tlog'})")
        elif missed:
            complain(f"{outcome.sentence}; requirement missed: {results}")
        else:
            say(f"{outcome.sentence}{'; requirement met: ' if results else ''}{results}")
        if rows:
            rows["log"] = str(directory / "flight.tlog")
            rows["all metrics"] = shlex.join(["offboard", "score", str(directory)])
        if page:
            rows["report"] = f"{page}, in some seconds"
        for label, text in rows.items():
            say(f"  {label:<{LABEL_WIDTH}}{text}", indent=2 + LABEL_WIDTH)
        sys.stdout.flush()
    except OSError as error:  # the exit code stays that of the flight
        drop(sys.stdout)
        complain(f"{outcome.sentence}; {explained(error)}")
    if code:
        raise typer.Exit(code)
