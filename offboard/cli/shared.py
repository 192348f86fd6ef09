"""What the commands share: output that fits the terminal, option types, and CommandError.

The module of a command imports the rest of the package when the command runs, so that `--help` and
wrong options are answered at once.
"""

from __future__ import annotations

import functools
import inspect
import itertools
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from offboard.documents.command_line import complain as complain
from offboard.documents.command_line import wrapped
from offboard.documents.errors import UserError, shown
from offboard.link.log import new_file

if TYPE_CHECKING:
    from offboard.run.configuration import FlightConfig
    from offboard.run.flight import Connection


class Output(Console):
    """A console that raises where nobody reads it any more: rich would exit with 1."""

    def on_broken_pipe(self) -> None:
        raise


out = Output(highlight=False)
err = Console(stderr=True, highlight=False)

DEFAULT_CONNECTION = "udpin:127.0.0.1:14540"
FLIGHTS = Path("flights")  # parent of the flight directories that have no --out
EXIT_CODES = "Exit codes: 0 done; 2 usage error, or a file that cannot be read or written."


def option(metavar: str, text: str, *names: str, **more: Any) -> Any:
    """A command-line option with a value, by default named as its parameter."""
    return typer.Option(*names, metavar=metavar, help=text, **more)


def _known_port(address: str | None) -> str | None:
    """Refuse to listen on any free port, to which nobody sends."""
    if address and re.fullmatch(r"(udp|tcp)in:.*:0+", address):
        raise CommandError(f"--connect {shown(address)}: give the port that the vehicle sends to")
    return address


NEW_DIRECTORY = "Directory of the results.  [default: a new one in flights]"
FILE = "NAME|FILE"  # the name of a shipped file, or a path
FLIGHT = typer.Argument(metavar="FLIGHT", help="Flight directory or .tlog file.")
Directory = Annotated[Path | None, option("DIR", NEW_DIRECTORY, "--out")]
Connect = Annotated[
    str | None,
    option(
        "LINK",
        "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or serial:DEVICE:BAUD; "
        f"IPv6 in brackets.  [default: {DEFAULT_CONNECTION}]",
        callback=_known_port,
    ),
]
Vehicle = Annotated[str | None, option(FILE, "Vehicle.")]
System = Annotated[
    int | None,
    typer.Option(
        metavar="N", min=1, max=255, help="System id of the vehicle, where several are heard."
    ),
]
SigningKey = Annotated[
    Path | None,
    option("FILE", "Sign all messages with this key and accept no others, see `offboard key`."),
]
Report = Annotated[
    bool, typer.Option(envvar="OFFBOARD_REPORT", help="Write report.html after each flight.")
]
Workers = Annotated[
    int | None,
    typer.Option(metavar="N", min=1, max=256, help="Processes.  [default: one per processor]"),
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
    """The options of a flight, the same for every command that flies or checks one."""

    connect: Connect = None
    system: System = None
    signing_key: SigningKey = None
    config: Annotated[str, option(FILE, "Configuration.")] = "flight"
    controller: Annotated[str | None, option(FILE, "Controller.")] = None
    reference: Annotated[str | None, option(FILE, "Reference; a file may also be .csv.")] = None
    vehicle: Vehicle = None
    assignments: Assignments = None

    def load(self, seed: int | None = None, known_vehicle: str | None = None) -> FlightConfig:
        """The configuration, see `configuration.load`. Raises DocumentError."""
        from offboard.run.configuration import load

        return load(
            self.config,
            choices={part: getattr(self, part) for part in ("controller", "reference", "vehicle")},
            assignments=self.assignments or (),
            seed=seed,
            known_vehicle=known_vehicle,
        )

    def connection(self) -> Connection:
        """The vehicle at a link."""
        from offboard.run.flight import Connection

        return Connection(self.connect or DEFAULT_CONNECTION, self.system, self.signing_key)


def with_flight_options(command: Callable[..., None]) -> Callable[..., None]:
    """A command whose first parameter is a `FlightOptions`, with each of its fields as an option
    before its own."""
    shared = inspect.signature(FlightOptions, eval_str=True).parameters
    _, *own = inspect.signature(command, eval_str=True).parameters.values()

    @functools.wraps(command)
    def run(**given: Any) -> None:
        options = FlightOptions(**{name: given.pop(name) for name in shared if name in given})
        command(options, **given)

    signature = inspect.Signature([*shared.values(), *own])
    run.__signature__ = signature  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in signature.parameters.values()}
    return run


class CommandError(UserError):
    """Ends the command with one sentence on stderr and an exit code."""

    def __init__(self, sentence: str, code: int = 2) -> None:
        super().__init__(sentence)
        self.code = code


def say(text: str, indent: int = 0) -> None:
    """Print a line to stdout, wrapped at words to the width; further lines are indented."""
    out.print(wrapped(text, out.width, indent), markup=False, soft_wrap=True)


def write(text: str) -> None:
    """Print text as it is, at once."""
    sys.stdout.write(text)
    sys.stdout.flush()


def check_new(path: Path, option_name: str) -> None:
    """Raise CommandError if the file chosen by an option exists, or has no directory."""
    if path.exists() or path.is_symlink():
        raise CommandError(f"{path} exists already; choose another file with {option_name}")
    if not path.parent.is_dir():
        raise CommandError(f"{option_name} {path}: there is no directory {path.parent}")


def free_name(path: Path) -> Path:
    """`path`, or the first of NAME-2, NAME-3 ... that does not exist."""
    numbered = (path.with_stem(f"{path.stem}-{number}") for number in itertools.count(2))
    return next(each for each in itertools.chain([path], numbered) if not each.exists())


def write_new(path: Path, text: str) -> None:
    """Write a file that must not exist. It appears when it is complete. Raises UserError."""
    with new_file(path) as file:
        file.write(text.encode())
