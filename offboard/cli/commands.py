"""The application: the commands of `offboard` and the options before them."""

from __future__ import annotations

from importlib.metadata import version
from typing import Annotated

import typer

from offboard.cli import (
    campaign,
    check,
    compare,
    daemon,
    doctor,
    export,
    fly,
    identify,
    key,
    listing,
    paper,
    replay,
    report,
    score,
    tune,
)
from offboard.cli.shared import EXIT_CODES, out
from offboard.documents import shipped
from offboard.documents.arguments import Command

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
PARTS = ("reference", "controller", "vehicle")
NAMES = shipped.overview(*PARTS, "scenario")


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


app.command(cls=Command, epilog=f"{NAMES}\n\n{fly.EXIT_CODES}")(fly.fly)
app.command(cls=Command, epilog=f"{shipped.overview(*PARTS)}\n\n{daemon.EXIT_CODES}")(daemon.daemon)
app.command(cls=Command, epilog=doctor.EXIT_CODES)(doctor.doctor)
app.command(cls=Command, epilog=score.EXIT_CODES)(score.score)
app.command(cls=Command, epilog=EXIT_CODES)(report.report)
app.command(cls=Command, epilog=check.EXIT_CODES)(check.check)
app.command(cls=Command, epilog=identify.EXIT_CODES)(identify.identify)
app.command(cls=Command, epilog=f"{NAMES}\n\n{compare.EXIT_CODES}")(compare.compare)
app.command(cls=Command, epilog=f"{shipped.overview('campaign')}\n\n{campaign.EXIT_CODES}")(
    campaign.campaign
)
app.command(cls=Command, epilog=f"{shipped.overview('tuning')}\n\n{tune.EXIT_CODES}")(tune.tune)
app.command(cls=Command, epilog=paper.EXIT_CODES)(paper.paper)
app.command(cls=Command, epilog=replay.EXIT_CODES)(replay.replay)
app.command(cls=Command, epilog=EXIT_CODES)(export.export)
app.command(cls=Command, epilog=EXIT_CODES)(key.key)
app.command("list", cls=Command)(listing.list_files)
