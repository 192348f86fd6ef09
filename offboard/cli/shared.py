"""Options and terminal output that several commands use.

The module of a command imports the rest of the package only when the command runs, so that `--help`
and wrong options are answered at once.
"""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from offboard.documents.arguments import FILE, option
from offboard.documents.command_line import complain, wrapped
from offboard.documents.errors import UserError
from offboard.documents.shipped import PARTS
from offboard.link.log import new_file

if TYPE_CHECKING:
    from offboard.analysis.history import History
    from offboard.analysis.score import Score
    from offboard.run.configuration import FlightConfig
    from offboard.run.flight import Connection, Simulated


class Output(Console):
    """A console that raises BrokenPipeError if the reader has closed the pipe. rich alone would
    exit with code 1."""

    def on_broken_pipe(self) -> None:
        raise


out, err = Output(highlight=False), Output(highlight=False, stderr=True)

DEFAULT_CONNECTION = "udpin:127.0.0.1:14540"
REFUSED = 3  # exit code
FLIGHTS = Path("flights")  # flight directories are created here if --out is not given


def absent(path: Path | None) -> Path | None:
    """Check an output path before the command does any work, and return it. Raises BadParameter if
    it exists, or if its directory does not exist."""
    if path and (path.exists() or path.is_symlink()):
        raise typer.BadParameter(f"{path} exists already; choose another file")
    if path and not path.parent.is_dir():
        raise typer.BadParameter(f"{path}: there is no directory {path.parent}")
    return path


NEW_DIRECTORY = "Directory of the results.  [default: a new one in flights]"
FLIGHT = typer.Argument(metavar="FLIGHT", help="Flight directory or .tlog file.")
Directory = Annotated[Path | None, option("DIR", NEW_DIRECTORY, "--out")]
LINK = (
    "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or serial:DEVICE:BAUD; "
    f"IPv6 in brackets.  [default: {DEFAULT_CONNECTION}]"
)
Vehicle = Annotated[str | None, option(FILE, "Vehicle.")]
System = Annotated[
    int | None,
    option("N", "System id of the vehicle, where several are heard.", min=1, max=255),
]
SigningKey = Annotated[
    Path | None,
    option("FILE", "Sign all messages with this key and accept no others, see `offboard key`."),
]
Report = Annotated[
    bool, typer.Option(envvar="OFFBOARD_REPORT", help="Write report.html after each flight.")
]
Workers = Annotated[
    int | None, option("N", "Processes.  [default: one per processor]", min=1, max=256)
]
Requirements = Annotated[
    list[str] | None,
    option(
        "METRIC<NUMBER", "Exit with 1 if the score does not meet this; repeatable.", "--require"
    ),
]
Assignments = Annotated[
    list[str] | None,
    option("KEY.PATH=VALUE", "Change one configuration value; repeatable.", "--set"),
]


@dataclass(frozen=True, slots=True)
class FlightOptions:
    """The options of every command that flies or checks a flight."""

    connect: Annotated[str | None, option("LINK", LINK)] = None
    system: System = None
    signing_key: SigningKey = None
    config: Annotated[str, option(FILE, "Configuration.")] = "flight"
    controller: Annotated[str | None, option(FILE, "Controller.")] = None
    reference: Annotated[str | None, option(FILE, "Reference; a file may also be .csv.")] = None
    vehicle: Vehicle = None
    assignments: Assignments = None

    def load(self, seed: int | None = None, known_vehicle: str | None = None) -> FlightConfig:
        """Load the configuration, see `configuration.load`. Raises DocumentError."""
        from offboard.run.configuration import load

        return load(
            self.config,
            choices={part: getattr(self, part) for part in PARTS},
            assignments=self.assignments or (),
            seed=seed,
            known_vehicle=known_vehicle,
        )

    def connection(self) -> Connection:
        """The vehicle that --connect, --system and --signing-key describe."""
        from offboard.run.flight import Connection

        return Connection(self.connect or DEFAULT_CONNECTION, self.system, self.signing_key)


@dataclass(frozen=True, slots=True)
class SitlOptions(FlightOptions):
    """The options of a command that can also fly the bundled simulator. Raises UserError if
    --sitl is combined with --connect or --system, or if options of --sitl are given without it."""

    sitl: Annotated[bool, typer.Option("--sitl", help="Fly the bundled simulator.")] = False
    firmware: Annotated[
        str | None, option("NAME", "With --sitl: px4 or ardupilot.  [default: px4]")
    ] = None
    scenario: Annotated[
        str | None, option(FILE, "With --sitl: scenario.  [default: errors of the firmware]")
    ] = None
    sim_vehicle: Annotated[
        str | None, option(FILE, "With --sitl: simulated vehicle; may differ from --vehicle.")
    ] = None

    def __post_init__(self) -> None:
        if self.sitl and self.connect:
            raise UserError("--sitl starts its own simulator: use --sitl or --connect, not both")
        if self.sitl and self.system:
            raise UserError("--system is an option of --connect: --sitl has one vehicle")
        if not self.sitl and (self.firmware or self.scenario or self.sim_vehicle):
            raise UserError(
                "--scenario, --sim-vehicle and --firmware are options of --sitl: add it"
            )

    def flown(self) -> Connection | Simulated:
        """The simulated vehicle with --sitl, else the vehicle at a link. Raises DocumentError."""
        if not self.sitl:
            return self.connection()
        from offboard.run.flight import Simulated

        firmware = self.firmware or "px4"
        simulated = Simulated(firmware, self.scenario, self.sim_vehicle, self.signing_key)
        simulated.check()
        return simulated


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Return a function for typer that calls `command`, whose first parameter is a dataclass of
    options. In the signature of that function the fields of the dataclass replace the parameter.
    """
    first, *others = inspect.signature(command, eval_str=True).parameters.values()
    group: type = first.annotation
    fields = inspect.signature(group, eval_str=True).parameters
    options = [*fields.values(), *others]

    @functools.wraps(command)
    def run(**given: Any) -> None:
        command(group(**{name: given.pop(name) for name in fields}), **given)

    run.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in options}
    return run


def say(text: str, indent: int = 0) -> None:
    """Print a line to stdout, wrapped between words to the width of the terminal; continuation
    lines are indented by `indent` columns."""
    out.print(wrapped(text, out.width, indent), markup=False, soft_wrap=True)


def say_each(texts: Mapping[str, str], margin: int = 2) -> None:
    """Print one line for each entry of `texts`: its name, then its text, in two columns."""
    width = max(map(len, texts), default=0) + 2
    for name, text in texts.items():
        say(f"{'':{margin}}{name:{width}}{text}", indent=margin + width)


def write(text: str) -> None:
    """Print `text` unchanged and flush stdout."""
    sys.stdout.write(text)
    sys.stdout.flush()


def write_new(path: Path, text: str) -> None:
    """Write a new file, which appears only once it is complete. Raises UserError if it exists or
    cannot be written."""
    with new_file(path) as file:
        file.write(text.encode())


def scored(flight: Path) -> tuple[Score, History]:
    """Score a flight and write score.json into its directory. Raises UserError."""
    from offboard.analysis.score import score_flight

    result, history = score_flight(flight)
    keep(flight, result, history)
    return result, history


def keep(flight: Path, result: Score, history: History) -> None:
    """Write score.json if `flight` is a directory. Print a sentence if it cannot be written."""
    from offboard.analysis.score import keep_score
    from offboard.link.log import LogError

    if flight.is_dir():
        try:
            keep_score(flight, result, history)
        except LogError as error:
            complain(str(error))
