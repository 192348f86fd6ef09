"""`offboard daemon`: the service that flies a vehicle whenever its pilot engages it."""

from __future__ import annotations

import sys
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

from offboard.cli.shared import (
    FLIGHTS,
    REFUSED,
    FlightOptions,
    Report,
    out,
    say,
    write,
)
from offboard.documents.arguments import option
from offboard.documents.command_line import DISK_ERRORS, complain, explained
from offboard.documents.errors import UserError
from offboard.documents.shipped import absolute

STATE = Path("/var/lib/offboard")  # state directory of the systemd unit
OUT = f"Directory of the flights' directories.  [default: {FLIGHTS}]"


def daemon(
    options: FlightOptions,
    anchor: Annotated[
        Literal["here", "origin"],
        typer.Option(help="Reference: start where the vehicle stops, or relative to the takeoff."),
    ] = "here",
    then: Annotated[
        Literal["hold", "land", "repeat"], typer.Option(help="After the reference.")
    ] = "hold",
    arms: Annotated[
        bool, typer.Option("--arms", help="May arm and take off when it is asked to start.")
    ] = False,
    seed: Annotated[int | None, option("N", "Random seed.")] = None,
    out_directory: Annotated[Path | None, option("DIR", OUT, "--out")] = None,
    metrics: Annotated[
        str | None,
        option("HOST:PORT", "Serve /metrics, /health and a page.  [default: off]"),
    ] = None,
    log_json: Annotated[
        bool, typer.Option("--log-json", help="Print one JSON object a line.")
    ] = False,
    print_unit: Annotated[
        bool,
        typer.Option(
            "--print-unit",
            help=f"Print a systemd unit with these options, which writes below {STATE}, and end.",
        ),
    ] = False,
    report: Report = True,
) -> None:
    """Wait for a vehicle, and fly whenever its pilot engages.

    Never arms without --arms. The pilot engages by switching to OFFBOARD (PX4) or GUIDED
    (ArduCopter) in the air, and takes the vehicle back by any other mode. Each engagement has a
    directory of its own, as that of `fly`. A ground station may send MAV_CMD_MISSION_START,
    MAV_CMD_DO_PAUSE_CONTINUE and MAV_CMD_DO_SET_MODE (hands back) to component 191.

    Exit codes: 0 stopped while no vehicle follows it; 2 usage or configuration error, nothing
    sent; 3 cannot begin now (another daemon has the connection, the disk is full), or stopped
    before a takeoff; 4 ended before the vehicle was handed back, or left armed.
    """
    if print_unit:
        options.load()
        _print_unit(options, out_directory)
        return
    from offboard.link.stop import StopRequests
    from offboard.live.lines import JsonLog, Terminal

    lines = JsonLog(write) if log_json else Terminal(out, partial(say, indent=12))
    with StopRequests() as stops, closing(lines):
        from offboard.flight.phases import ServiceOptions
        from offboard.service.daemon import run

        try:
            outcome = run(
                partial(options.load, seed),
                options.connection(),
                out_directory or FLIGHTS,
                options=ServiceOptions(anchor, then, arms),
                metrics=metrics,
                report=report,
                stops=stops,
                tell=lines.tell,
                show=lines.show,
            )
        except (UserError, OSError) as error:
            if not disk_is_full(error):
                raise
            sentence = explained(error) if isinstance(error, OSError) else str(error)
            raise UserError(sentence, REFUSED) from None
    if outcome.exit_code:
        raise UserError(outcome.sentence, outcome.exit_code)


def disk_is_full(error: UserError | OSError) -> bool:
    """Whether the cause is a disk error, such as a full disk: then a later attempt may succeed."""
    cause = error if isinstance(error, OSError) else error.__context__
    return isinstance(cause, OSError) and cause.errno in DISK_ERRORS


def _print_unit(options: FlightOptions, out_directory: Path | None) -> None:
    """Print the systemd unit, and on stderr a sentence for each file that the unit's user cannot
    read. Raises UserError."""
    import offboard
    from offboard.documents.signing_key import read_key
    from offboard.service.daemon import unit, unreadable

    if out_directory and STATE not in (out_directory, *out_directory.parents):
        raise UserError(
            f"--out {out_directory}: the unit can write below {STATE} alone: omit --out, or name a "
            "directory there"
        )
    if options.signing_key:
        read_key(options.signing_key)
    arguments = [
        _absolute(word)
        for word in sys.argv[sys.argv.index("daemon") + 1 :]
        if word.partition("=")[0] not in ("--print-unit", "--signing-key")
        and Path(word) != options.signing_key
    ]
    write(unit(arguments, options.connection().address, options.signing_key))
    installed = [Path(sys.executable), Path(offboard.__path__[0])]
    files = (options.config, options.controller, options.reference, options.vehicle)
    named = [Path(file) for file in files if file and Path(file).is_file()]
    for path in (*installed, *named):
        if hidden := unreadable(path):
            complain(hidden)


def _absolute(word: str) -> str:
    """A word of the command line, in which the path of an existing file is made absolute: the unit
    runs in another directory."""
    option, equals, value = word.partition("=") if word.startswith("--") else ("", "", word)
    if not Path(value).exists():
        return word
    return f"{option}{equals}{absolute(value)}"
