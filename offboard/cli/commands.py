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


# the commands in the order of --help, and what their --help says below the options
for command, below in (
    (fly.fly, (shipped.overview(*PARTS, "scenario"), fly.EXIT_CODES)),
    (daemon.daemon, (shipped.overview(*PARTS), daemon.EXIT_CODES)),
    (doctor.doctor, (doctor.EXIT_CODES,)),
    (score.score, (score.EXIT_CODES,)),
    (report.report, (EXIT_CODES,)),
    (check.check, (check.EXIT_CODES,)),
    (identify.identify, (shipped.overview(*PARTS, "scenario"), identify.EXIT_CODES)),
    (compare.compare, (shipped.overview(*PARTS, "scenario"), compare.EXIT_CODES)),
    (campaign.campaign, (shipped.overview("campaign"), campaign.EXIT_CODES)),
    (tune.tune, (shipped.overview("tuning"), tune.EXIT_CODES)),
    (paper.paper, (paper.EXIT_CODES,)),
    (replay.replay, (replay.EXIT_CODES,)),
    (export.export, (EXIT_CODES,)),
    (key.key, (EXIT_CODES,)),
):
    app.command(cls=Command, epilog="\n\n".join(below))(command)
app.command("list", cls=Command)(listing.list_files)
