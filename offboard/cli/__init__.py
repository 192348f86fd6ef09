"""The `offboard` command: one module for each of its commands, and what they share in `shared`."""

from __future__ import annotations

import signal
from importlib.metadata import version
from typing import Annotated

import typer

from offboard.cli import check, compare, fly, identify, listing, paper, score
from offboard.cli.shared import EXIT_CODES, CommandError, complain, out
from offboard.documents import shipped
from offboard.documents.errors import UserError

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
NAMES = shipped.overview("reference", "controller", "vehicle", "scenario")


def _version(wanted: bool) -> None:
    if wanted:
        out.print(f"pso-offboard {version('pso-offboard')}")
        raise typer.Exit


@app.callback()
def offboard(
    show_version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    """Fly a trajectory over MAVLink with a particle-swarm receding-horizon law, and score it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # until here: see __main__


app.command(epilog=f"{NAMES}\n\n{EXIT_CODES}")(fly.fly)
app.command(epilog=EXIT_CODES)(score.score)
app.command(epilog=EXIT_CODES)(check.check)
app.command(epilog=EXIT_CODES)(identify.identify)
app.command(epilog=f"{NAMES}\n\n{EXIT_CODES}")(compare.compare)
app.command(epilog=EXIT_CODES)(paper.paper)
app.command("list")(listing.list_files)


def main() -> None:
    """Run the command in `sys.argv`. An error of the user is printed without a traceback."""
    try:
        app()
    except UserError as error:
        complain(str(error))
        raise SystemExit(error.code if isinstance(error, CommandError) else 2) from None
