"""The `offboard` command: parse, load, call, print. An error is one sentence and an exit code."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

app = typer.Typer(
    help="Fly a trajectory over MAVLink with a particle-swarm receding-horizon law, and score it.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
out = Console(highlight=False)
err = Console(stderr=True, highlight=False, soft_wrap=True)

DEFAULT_CONNECTION = "udpin:127.0.0.1:14540"
EXIT_HELP = (
    "Exit codes: 0 flown and all requirements met; 1 a requirement missed; 2 usage or "
    "configuration error, nothing sent; 3 no vehicle, or refused; 4 aborted in flight."
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
        str,
        typer.Option(help="udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, serial:DEVICE:BAUD."),
    ] = DEFAULT_CONNECTION,
    config: Annotated[str, typer.Option(help="A shipped configuration, or a file.")] = "flight",
    controller: Annotated[str | None, typer.Option(help="A shipped controller, or a file.")] = None,
    reference: Annotated[
        str | None, typer.Option(help="A shipped reference, or a .yaml or .csv file.")
    ] = None,
    vehicle: Annotated[str | None, typer.Option(help="A shipped vehicle, or a file.")] = None,
    scenario: Annotated[
        str, typer.Option(help="With --sitl: a shipped scenario, or a file.")
    ] = "px4_like",
    sim_vehicle: Annotated[
        str, typer.Option(help="With --sitl: what flies, whatever is believed of it.")
    ] = "px4_sih",
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
    from offboard.analysis.requirement import Requirement
    from offboard.analysis.score import FIGURES
    from offboard.config import build_track, dump, load
    from offboard.control.catalogue import build
    from offboard.control.observer import Observer
    from offboard.flight import clock
    from offboard.flight.companion import Companion
    from offboard.flight.log import FlightLog
    from offboard.flight.phases import ExitCode
    from offboard.flight.run import Bundled, Crew
    from offboard.flight.run import fly as fly_once

    named = {"controller": controller, "reference": reference, "vehicle": vehicle}
    resolved = load(
        config,
        choices={part: name for part, name in named.items() if name is not None},
        assignments=assignments or (),
        seed=seed,
    )
    requirements = [Requirement.parse(text, FIGURES) for text in require or ()]
    track = build_track(resolved)
    crew = Crew(
        vehicle=resolved.vehicle,
        controller=build(
            resolved.controller,
            resolved.vehicle,
            resolved.period_s,
            resolved.seed,
            clock.monotonic_s,
        ),
        make_observer=lambda: Observer(resolved.vehicle, resolved.observer),
        track=track,
        limits=resolved.limits,
        period_s=resolved.period_s,
        deadline_s=resolved.deadline_s,
        learning=resolved.identify,
    )
    shown = 0

    def progress(companion: Companion) -> None:
        nonlocal shown
        for line in companion.announced[shown:]:
            out.print(f"{companion.view.time_s:8.2f} s  {line}")
        shown = len(companion.announced)

    def prepared(seconds: float) -> None:
        if seconds > 2.0:
            out.print(f"compiled in {seconds:.1f} s; the next start finds it cached")

    directory = out_directory or Path("flights") / clock.local_stamp()
    log = FlightLog(directory, dump(resolved))
    out.print("preparing the controller (its first run on a machine compiles for seconds)")
    try:
        outcome = fly_once(
            crew,
            log,
            connection=connect,
            bundled=Bundled(scenario, resolved.seed, sim_vehicle) if sitl else None,
            progress=progress,
            prepared=prepared,
        )
    except KeyboardInterrupt:  # in flight it lands instead
        raise Refusal("interrupted before anything was sent", ExitCode.ABORTED) from None
    if outcome.exit_code == ExitCode.USAGE:
        raise Refusal(outcome.sentence)
    if outcome.exit_code != ExitCode.FLOWN:
        _score(directory, [], as_json=False)
        raise Refusal(f"{outcome.sentence} (log: {log.path})", outcome.exit_code)
    missed = _score(directory, requirements, as_json=False)
    out.print(f"{outcome.sentence}; recorded in {directory}")
    if missed:
        raise Refusal("; ".join(missed), ExitCode.REQUIREMENT_MISSED)


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
    """Validate configuration files without flying; a flight's reference must be flyable too."""
    from offboard.config import check_file
    from offboard.model.document import DocumentError

    problems = []
    for path in files:
        try:
            out.print(f"{path}: {check_file(path)}, valid")
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
    from offboard.config import flown, load
    from offboard.flight import clock

    if (flight is None) == (connect is None and not sitl):
        raise Refusal("name a FLIGHT, or fly one first with --connect or --sitl; not both")
    if flight is None:
        flight = out_directory or Path("flights") / f"identify-{clock.local_stamp()}"
        fly(
            sitl=sitl,
            connect=connect or DEFAULT_CONNECTION,
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
        if output is not None:
            output.write_text(text, encoding="utf-8")
        shown.write_text(fits(flight.name, found, trace, believed), encoding="utf-8")
    except OSError as error:
        raise Refusal(f"{error.filename} cannot be written ({error.strerror})") from None
    out.print(text, end="", markup=False, soft_wrap=True)
    written = f"{output} and {shown}" if output else f"{shown}; -o FILE writes the vehicle file"
    out.print(f"written: {written}", markup=False, soft_wrap=True)
    if not found.supported:
        raise Refusal("nothing could be identified from this flight", 1)


def _score(flight: Path, requirements: list, as_json: bool) -> list[str]:  # type: ignore[type-arg]
    """Score, write score.json beside a flight's log, print; return the missed requirements."""
    from offboard.analysis import history, tlog
    from offboard.analysis import score as scoring
    from offboard.analysis.document import as_document
    from offboard.analysis.table import show

    path = tlog.find(flight)
    flown = history.gather(tlog.read(path))
    result = scoring.score(flown)
    text = json.dumps(as_document(result, flown), indent=2, allow_nan=False)
    if flight.is_dir():
        (flight / "score.json").write_text(text + "\n", encoding="utf-8")
    if as_json:
        sys.stdout.write(text + "\n")
    else:
        show(out, result, flown)
    verdicts = [requirement.verdict(result.figures()) for requirement in requirements]
    return [verdict for verdict in verdicts if verdict]


def main() -> None:
    """Console entry: no traceback for anything that a user can mend."""
    from offboard.analysis.requirement import RequirementError
    from offboard.analysis.tlog import TlogError
    from offboard.flight.link import LinkError
    from offboard.flight.log import LogError
    from offboard.model.document import DocumentError

    try:
        app()
    except Refusal as refusal:
        err.print(str(refusal), markup=False)
        raise SystemExit(refusal.code) from None
    except (RequirementError, TlogError, LinkError, LogError, DocumentError) as error:
        err.print(str(error), markup=False)
        raise SystemExit(2) from None
