"""The `offboard` command: parse, load, call, print. An error is one sentence and an exit code."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

if TYPE_CHECKING:
    from offboard.flight.companion import Companion

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
out = Console(highlight=False)
err = Console(stderr=True, highlight=False, soft_wrap=True)

DEFAULT_CONNECTION = "udpin:127.0.0.1:14540"
INTERRUPTED = "interrupted before anything was sent"
EXIT_HELP = (
    "Exit codes: 0 flown and all requirements met; 1 a requirement missed; 2 usage or "
    "configuration error, nothing sent; 3 not flown: no vehicle, refused, or stopped on the "
    "ground; 4 aborted in flight, or left armed."
)

Requirements = Annotated[
    list[str] | None,
    typer.Option("--require", help="'FIGURE<NUMBER', repeatable: exit 1 if the score misses it."),
]
Assignments = Annotated[
    list[str] | None,
    typer.Option("--set", help="key.path=value, repeatable: change one configuration value."),
]
FlightArgument = Annotated[
    Path, typer.Argument(metavar="FLIGHT", help="A flight directory or a .tlog file.")
]


def _version(wanted: bool) -> None:
    if wanted:
        out.print(f"pso-offboard {version('pso-offboard')}")
        raise typer.Exit


@app.callback()
def offboard(
    show_version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Say which one it is."),
    ] = False,
) -> None:
    """Fly a trajectory over MAVLink with a particle-swarm receding-horizon law, and score it."""


class Refusal(Exception):
    """Ends the command: one sentence for stderr and the exit code."""

    def __init__(self, sentence: object, code: int = 2) -> None:
        super().__init__(str(sentence))
        self.code = code


@app.command(epilog=EXIT_HELP)
def fly(
    sitl: Annotated[
        bool, typer.Option("--sitl", help="Fly the bundled simulator, started for this flight.")
    ] = False,
    connect: Annotated[
        str | None,
        typer.Option(
            help="udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, serial:DEVICE:BAUD.",
            show_default=DEFAULT_CONNECTION,
        ),
    ] = None,
    config: Annotated[str, typer.Option(help="A shipped configuration, or a file.")] = "flight",
    controller: Annotated[str | None, typer.Option(help="A shipped controller, or a file.")] = None,
    reference: Annotated[
        str | None, typer.Option(help="A shipped reference, or a .yaml or .csv file.")
    ] = None,
    vehicle: Annotated[str | None, typer.Option(help="A shipped vehicle, or a file.")] = None,
    firmware: Annotated[
        str, typer.Option(help="With --sitl: whose behaviour, px4 or ardupilot.")
    ] = "px4",
    scenario: Annotated[
        str | None, typer.Option(help="With --sitl: a scenario or a file; else the firmware's own.")
    ] = None,
    sim_vehicle: Annotated[
        str | None,
        typer.Option(help="With --sitl: what flies, whatever is believed of it."),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Of the swarm, and with --sitl of the simulator.")
    ] = None,
    out_directory: Annotated[
        Path | None, typer.Option("--out", help="Flight directory; a new one by default.")
    ] = None,
    require: Requirements = None,
    assignments: Assignments = None,
) -> None:
    """Connect, arm, take off, track the reference, land; log everything and score it."""
    from offboard.flight.sitl import SimulatorProcess
    from offboard.flight.stop import StopRequests

    if sitl and connect:
        raise Refusal("--sitl flies a simulator of its own: leave --connect out, or --sitl")
    if not sitl and (scenario or sim_vehicle or firmware != "px4"):
        raise Refusal("--scenario, --sim-vehicle and --firmware are the simulator's: add --sitl")
    named = {"controller": controller, "reference": reference, "vehicle": vehicle}
    try:
        with (
            StopRequests(_leave) as stops,
            SimulatorProcess() if sitl else nullcontext() as simulator,  # it loads while we do
        ):
            from offboard.analysis.requirement import Requirement
            from offboard.analysis.score import FIGURES
            from offboard.flight import clock
            from offboard.flight.request import FlightRequest, fly_request

            requirements = [Requirement.parse(text, FIGURES) for text in require or ()]
            directory = out_directory or Path("flights") / clock.local_stamp()
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
            outcome = fly_request(request, _announcer(), out.print, simulator, stops)
    except KeyboardInterrupt:  # in flight it lands instead
        raise Refusal(INTERRUPTED) from None
    if outcome.exit_code == 2:
        raise Refusal(outcome.sentence)
    missed = _score(directory, [] if outcome.exit_code else requirements, as_json=False)
    if outcome.exit_code:
        log = directory / "flight.tlog"
        raise Refusal(f"{outcome.sentence} (log: {log})", outcome.exit_code)
    out.print(f"{outcome.sentence}; recorded in {directory}")
    if missed:
        raise Refusal("; ".join(missed), 1)


def _leave() -> None:
    """At once, whatever is being compiled; a simulator ends with the pipe that we hold."""
    os.write(2, f"{INTERRUPTED}\n".encode())
    os._exit(2)


def _announcer() -> Callable[[Companion], None]:
    """Prints what is new each time that it is called."""
    shown = 0

    def announce(companion: Companion) -> None:
        nonlocal shown
        for line in companion.announced[shown:]:
            out.print(f"{companion.state.time_s:8.2f} s  {line}", markup=False, soft_wrap=True)
        shown = len(companion.announced)

    return announce


@app.command(epilog=EXIT_HELP)
def score(
    flight: FlightArgument,
    as_json: Annotated[bool, typer.Option("--json", help="Print the score as JSON.")] = False,
    require: Requirements = None,
) -> None:
    """Score a flight from its .tlog alone."""
    from offboard.analysis.requirement import Requirement
    from offboard.analysis.score import FIGURES

    requirements = [Requirement.parse(text, FIGURES) for text in require or ()]
    missed = _score(flight, requirements, as_json)
    if missed:
        raise Refusal("; ".join(missed), 1)


@app.command(epilog=EXIT_HELP)
def check(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Configuration files.")],
) -> None:
    """Validate what a flight may be given, without flying: configurations, vehicles, controllers,
    references (.yaml or .csv; they must be flyable too) and the simulator's scenarios."""
    from offboard.documents.reading import DocumentError
    from offboard.flight.configuration import check_file
    from offboard.flight.sitl import check_scenario

    problems = []
    for path in files:
        try:
            out.print(f"{path}: {check_file(path, check_scenario)}, valid")
        except DocumentError as error:
            problems.append(str(error))
    if problems:
        raise Refusal("\n".join(problems))


@app.command(epilog=EXIT_HELP)
def identify(
    flight: Annotated[
        Path | None, typer.Argument(metavar="[FLIGHT]", help="A flight directory or a .tlog file.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="The vehicle file to write.")
    ] = None,
    page: Annotated[
        Path | None, typer.Option(help="The page with the fits; beside the log by default.")
    ] = None,
    connect: Annotated[
        str | None, typer.Option(help="Fly the reference `identify` there first, then use its log.")
    ] = None,
    sitl: Annotated[
        bool, typer.Option("--sitl", help="The same on the bundled simulator.")
    ] = False,
    vehicle: Annotated[
        str | None, typer.Option(help="Believed beforehand: a shipped vehicle, or a file.")
    ] = None,
    out_directory: Annotated[
        Path | None, typer.Option("--out", help="Flight directory of --connect and --sitl.")
    ] = None,
) -> None:
    """Delay, attitude response, thrust, drag and noise from a log: a vehicle file and a page."""
    from offboard.analysis import history, tlog
    from offboard.analysis.identify import identify_flight, vehicle_file
    from offboard.analysis.identify_page import page as fits
    from offboard.flight import clock
    from offboard.flight.configuration import flown, load

    if (flight is None) == (connect is None and not sitl):
        raise Refusal("name a FLIGHT, or fly one first with --connect or --sitl; not both")
    if output is not None and output.exists():
        raise Refusal(f"{output} exists already; choose another file with -o")
    if flight is None:
        flight = out_directory or Path("flights") / f"identify-{clock.local_stamp()}"
        fly(
            sitl=sitl,
            connect=connect,
            reference="identify",
            vehicle=vehicle,
            out_directory=flight,
        )
    path = tlog.find(flight)
    log = tlog.read(path)
    with_what = history.configuration(log)
    if vehicle is None and with_what is not None:
        believed = flown(with_what).vehicle
    else:
        believed = load("flight", choices={"vehicle": vehicle} if vehicle else {}).vehicle
    found, trace = identify_flight(log, history.gather(log), believed)
    text = vehicle_file(found, believed, flight.name)
    shown = page or path.with_name("identify.html")
    try:
        shown.write_text(fits(flight.name, found, trace, believed), encoding="utf-8")
        if not found.supported:
            raise Refusal(f"nothing could be identified from this flight; {shown} says why", 1)
        if output is not None:
            output.write_text(text, encoding="utf-8")
    except OSError as error:
        raise Refusal(f"{error.filename} cannot be written ({error.strerror})") from None
    out.print(text, end="", markup=False, soft_wrap=True)
    written = f"{output} and {shown}" if output else f"{shown}; -o FILE writes the vehicle file"
    out.print(f"written: {written}", markup=False, soft_wrap=True)


@app.command(epilog=EXIT_HELP)
def compare(
    controllers: Annotated[
        str, typer.Option(help="Comma-separated names or files, or 'all'.")
    ] = "pso,lqr,paper",
    reference: Annotated[str, typer.Option(help="Comma-separated names or files.")] = "lemniscate",
    scenario: Annotated[
        str, typer.Option(help="Comma-separated names or files of the simulator.")
    ] = "calm,px4_like",
    seeds: Annotated[int, typer.Option(help="Flights of each, seeds 1 .. this, at most 1000.")] = 3,
    vehicle: Annotated[str | None, typer.Option(help="A shipped vehicle, or a file.")] = None,
    connect: Annotated[
        str | None,
        typer.Option(help="Fly whatever is there, one flight after the other, not the simulator."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Processes, 1 .. 256; one per processor by default.")
    ] = None,
    out_directory: Annotated[
        Path | None, typer.Option("--out", help="Directory of all flights; a new one by default.")
    ] = None,
    assignments: Assignments = None,
) -> None:
    """Fly controllers x references x scenarios x seeds; one table with medians and ranges."""
    if workers is not None and not 1 <= workers <= 256:
        raise Refusal(f"--workers {workers}: give 1 .. 256")
    if not 1 <= seeds <= 1000:
        raise Refusal(f"--seeds {seeds}: give 1 .. 1000")
    from offboard.analysis.comparison import compare_all
    from offboard.analysis.trial import check_flyable, fly_trial
    from offboard.documents import shipped
    from offboard.documents.shipped import locate
    from offboard.flight import clock
    from offboard.flight.request import FlightRequest
    from offboard.flight.sitl import check_scenario

    known = shipped.names("controllers")
    laws, references = _list(controllers, known), _list(reference)
    scenarios = _list(scenario) if connect is None else ["connected"]
    if connect is None:
        files = [locate(name, "scenarios", "scenario") for name in scenarios]
        for path in files:
            if shipped.directory() not in path.parents:
                check_scenario(path)
    directory = out_directory or Path("flights") / f"compare-{clock.local_stamp()}"
    request = FlightRequest(
        directory=directory,
        choices={"vehicle": vehicle} if vehicle else {},
        assignments=tuple(assignments or ()),
        connection=connect or DEFAULT_CONNECTION,
        sitl=connect is None,
    )
    check_flyable(request, laws, references)
    problem = compare_all(
        partial(fly_trial, request),
        controllers=laws,
        references=references,
        scenarios=scenarios,
        seeds=range(1, seeds + 1),
        directory=directory,
        workers=workers if connect is None else 0,
        console=out,
    )
    if problem:
        raise Refusal(problem, 4)


@app.command(epilog=EXIT_HELP)
def paper(
    out_directory: Annotated[
        Path | None, typer.Option("--out", help="Where page, tables and figures go.")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Few seeds: seconds, not minutes.")
    ] = False,
    seeds: Annotated[int | None, typer.Option(help="Flights per row; 20 by default.")] = None,
    initial_q: Annotated[
        str | None, typer.Option(help="diag(Q) of Eq. 23, 1 or 12 comma-separated weights.")
    ] = None,
    figure: Annotated[list[str] | None, typer.Option(help="Only this figure, repeatable.")] = None,
    table: Annotated[list[str] | None, typer.Option(help="Only this table, repeatable.")] = None,
    workers: Annotated[
        int | None, typer.Option(help="Processes; one per processor by default.")
    ] = None,
) -> None:
    """Tables 2-4 and figures 4-17 of the paper, ours beside theirs, certified, on one page."""
    from offboard.flight import clock
    from offboard.paper.study.options import PaperError, PaperOptions
    from offboard.paper.study.run import reproduce

    try:
        weights = None if initial_q is None else tuple(float(w) for w in initial_q.split(","))
    except ValueError:
        raise Refusal(f"--initial-q {initial_q}: 1 or 12 numbers with commas between") from None
    options = PaperOptions(
        out=out_directory or Path("flights") / f"paper-{clock.local_stamp()}",
        quick=quick,
        seeds=seeds,
        initial_q=weights,
        figures=tuple(figure or ()),
        tables=tuple(table or ()),
        workers=workers,
    )
    try:
        outcome = reproduce(options, err)
    except PaperError as error:
        raise Refusal(error) from None
    out.print(f"written: {outcome.page}", markup=False, soft_wrap=True)
    if outcome.missing:
        parts = "; ".join(f"{label}: {why}" for label, why in outcome.missing.items())
        raise Refusal(f"missing: {parts}", 1)


def _list(text: str, known: Sequence[str] = ()) -> list[str]:
    """Comma-separated names; 'all' stands for every known one."""
    parts = [part.strip() for part in text.split(",") if part.strip()]
    if not parts:
        raise Refusal("an empty list of names; give at least one")
    return list(known) if parts == ["all"] and known else list(dict.fromkeys(parts))


def _score(flight: Path, requirements: list, as_json: bool) -> list[str]:  # type: ignore[type-arg]
    """Score, write score.json beside a flight's log, print; return the missed requirements."""
    from offboard.analysis.document import as_text
    from offboard.analysis.table import show
    from offboard.analysis.trial import keep_score, score_flight
    from offboard.flight.log import LogError

    result, flown = score_flight(flight)
    if flight.is_dir():
        try:
            keep_score(flight, result, flown)
        except LogError as error:  # the score itself is still worth printing
            err.print(str(error), markup=False)
    if as_json:
        sys.stdout.write(as_text(result, flown))
    else:
        show(out, result, flown)
    verdicts = [requirement.verdict(result.figures()) for requirement in requirements]
    return [verdict for verdict in verdicts if verdict]


def main() -> None:
    """Console entry: no traceback for anything that a user can mend."""
    from offboard.analysis.requirement import RequirementError
    from offboard.analysis.tlog import TlogError
    from offboard.documents.reading import DocumentError
    from offboard.flight.link import LinkError
    from offboard.flight.log import LogError

    try:
        app()
    except Refusal as refusal:
        err.print(str(refusal), markup=False)
        raise SystemExit(refusal.code) from None
    except (RequirementError, TlogError, LinkError, LogError, DocumentError) as error:
        err.print(str(error), markup=False)
        raise SystemExit(2) from None
