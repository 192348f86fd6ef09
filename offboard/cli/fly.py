"""`offboard fly`: one flight, whose phases are printed as they happen, and its result."""

from __future__ import annotations

import os
import sys
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from offboard.cli.shared import (
    FLIGHTS,
    Directory,
    Report,
    Requirements,
    SitlOptions,
    out,
    say,
    say_each,
    scored,
    write,
)
from offboard.documents.arguments import LIVE_PAGE, option
from offboard.documents.command_line import INTERRUPT, complain, drop, explained
from offboard.documents.errors import UserError, plain, typed

if TYPE_CHECKING:
    from offboard.analysis.score import Requirement
    from offboard.flight.phases import Outcome

INTERRUPTED = "interrupted before anything was sent"


def fly(
    options: SitlOptions,
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
    try:
        from offboard.link.stop import StopRequests
        from offboard.run.sitl import SimulatorProcess

        with (
            StopRequests(_exit_at_once) as stops,
            SimulatorProcess() if options.sitl else nullcontext() as simulator,
            ExitStack() as stack,
        ):
            from offboard.analysis.score import Requirement
            from offboard.link import clock
            from offboard.live.lines import JsonLines, Terminal
            from offboard.live.process import Displays, LiveProcess
            from offboard.run.flight import fly as fly_once

            lines = JsonLines(write) if json_lines else Terminal(out, partial(say, indent=12))
            displays = Displays(lines, [LiveProcess("--live", live)] if live else [])
            stack.callback(displays.close)
            requirements = [Requirement.parse(text) for text in require or ()]
            directory = out_directory or FLIGHTS / clock.local_stamp()
            flown = options.flown()
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
    """Exit, even while functions are compiled. The simulator ends as its pipe closes."""
    os.write(2, f"{INTERRUPTED}\n".encode())
    os._exit(INTERRUPT)


def _conclude(
    outcome: Outcome,
    directory: Path,
    requirements: list[Requirement],
    lost: list[str],
    *,
    page: str,
    json_lines: bool,
) -> None:
    """Print verdict and result, and exit with the code of the verdict.

    If the flight cannot be scored, for example because its log was deleted meanwhile, every
    requirement is missed. `lost` are sentences about the parts of the flight that were not shown;
    `page` is the path of the report that is about to be written, empty without one.
    """
    from offboard.analysis.score import Score, judged
    from offboard.analysis.score_table import summary
    from offboard.live.display import DIGITS, line

    log = str(directory / "flight.tlog")
    try:
        score, history = scored(directory)
        outcome, rows = judged(outcome, score), summary(score, history)
    except (UserError, KeyboardInterrupt) as error:
        score = Score(ended_by=f"it cannot be scored: {str(error) or 'interrupted'}")
        rows = {"log": log} if isinstance(error, KeyboardInterrupt) else {}
        page = page if rows else ""
        outcome = replace(outcome, sentence=f"{outcome.sentence}; {score.ended_by}")
    metrics = score.metrics()
    checked = [] if outcome.exit_code else requirements
    missed = [each for each in checked if not each.met(metrics)]
    results = "; ".join(each.sentence(metrics) for each in missed or checked)
    code = outcome.exit_code or int(bool(missed))
    try:
        if json_lines:
            result = line(
                "result",
                exit_code=code,
                sentence=outcome.sentence,
                requirements=results,
                completed=score.completed == 1.0,
                ended_by=score.ended_by,
                directory=str(directory),
                lost=lost,
                figures=plain(metrics, DIGITS),
            )
            write(f"{result}\n")
            raise typer.Exit(code)
        out.print()
        for sentence in lost:
            say(sentence)
        verdict = outcome.sentence
        if outcome.exit_code:
            verdict += f" (log: {log})"
        elif results:
            verdict += f"; requirement {'missed' if missed else 'met'}: {results}"
        (complain if code else say)(verdict)
        if rows:
            rows |= {"log": log, "all metrics": typed("offboard", "score", directory)}
        if page:
            rows["report"] = f"{page}, in some seconds"
        say_each(rows)
        sys.stdout.flush()
    except OSError as error:  # the exit code stays that of the flight
        drop(sys.stdout)
        complain(f"{outcome.sentence}; {explained(error)}")
    if code:
        raise typer.Exit(code)
