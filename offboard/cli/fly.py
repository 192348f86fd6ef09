"""`offboard fly`: one flight, whose phases are printed as they happen, and its result."""

from __future__ import annotations

import os
import sys
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

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
from offboard.documents.command_line import INTERRUPT, complain, drop, explained, told
from offboard.documents.errors import UserError, located, plain, typed

if TYPE_CHECKING:
    from offboard.analysis.score import Requirement, Score
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

        with StopRequests(_exit_at_once) as stops, ExitStack() as stack:
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
        result = _judged(outcome, directory, requirements)
        try:
            if json_lines:
                write(result.as_json(directory, displays.lost))
            else:
                result.show(directory, displays.lost, page)
        except OSError as error:
            drop(sys.stdout)
            complain(f"{result.outcome.sentence}; {explained(error)}")
    finally:
        if report:
            from offboard.link.after_flight import begin_report

            begin_report(directory)
    if result.code:
        raise typer.Exit(result.code)


def _exit_at_once() -> None:
    """Exit, even while functions are compiled. The simulator ends as its pipe closes."""
    os.write(2, f"{INTERRUPTED}\n".encode())
    os._exit(INTERRUPT)


class Result(NamedTuple):
    """What `fly` prints after the flight. `rows` are texts by label, `requirements` is a sentence
    about the requirements that were checked, and `code` is the exit code."""

    outcome: Outcome
    score: Score
    rows: dict[str, str]
    requirements: str
    code: int

    def as_json(self, directory: Path, lost: list[str]) -> str:
        """The last line of --json-lines. `lost` are sentences about what was not shown."""
        from offboard.live.display import DIGITS, line

        result = line(
            "result",
            exit_code=self.code,
            sentence=self.outcome.sentence,
            requirements=self.requirements,
            completed=self.score.completed == 1.0,
            ended_by=self.score.ended_by,
            directory=str(directory),
            lost=lost,
            figures=plain(self.score.metrics(), DIGITS),
        )
        return f"{result}\n"

    def show(self, directory: Path, lost: list[str], page: str) -> None:
        """Print the result. `page`: path of the report that is about to be written, or empty."""
        out.print()
        for sentence in lost:
            say(sentence)
        log, verdict, rows = directory / "flight.tlog", self.outcome.sentence, dict(self.rows)
        if self.outcome.exit_code:
            verdict += f" (log: {log})"
        elif self.requirements:
            verdict += f"; requirement {'missed' if self.code else 'met'}: {self.requirements}"
        (complain if self.code else say)(verdict)
        if log.exists():
            rows |= {"log": str(log), "all metrics": typed("offboard", "score", directory)}
            rows |= {"report": f"{page}, in some seconds"} if page else {}
        say_each(rows)
        sys.stdout.flush()


def _judged(outcome: Outcome, directory: Path, requirements: list[Requirement]) -> Result:
    """Score the flight and check its requirements. If it cannot be scored, for example because its
    log was deleted meanwhile, every requirement is missed, and the exit code stays that of the
    flight."""
    from offboard.analysis.score import Score, judged
    from offboard.analysis.score_table import summary

    rows: dict[str, str] = {}
    unscored: str | None = None
    try:
        score, history = scored(directory)
        outcome, rows = judged(outcome, score), summary(score, history)
    except (OSError, MemoryError, KeyboardInterrupt) as error:
        unscored, _ = told(error)
    except Exception as error:  # also a bug of ours, after an aborted flight
        unscored = located(error)
    if unscored is not None:
        score = Score(ended_by=f"it cannot be scored: {unscored}")
        outcome = replace(outcome, sentence=f"{outcome.sentence}; {score.ended_by}")
    metrics = score.metrics()
    checked = [] if outcome.exit_code else requirements
    missed = [each for each in checked if not each.met(metrics)]
    sentences = "; ".join(each.sentence(metrics) for each in missed or checked)
    return Result(outcome, score, rows, sentences, outcome.exit_code or int(bool(missed)))
