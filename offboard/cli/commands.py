"""The application: the commands of `offboard` and the options before them."""

from __future__ import annotations

from importlib.metadata import version
from typing import Annotated

import typer

from offboard.cli import campaign, daemon, doctor, files, fly, logs, paper
from offboard.cli.shared import out
from offboard.documents import shipped
from offboard.documents.arguments import Command

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


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


# the commands in the order of --help, and the kinds of shipped files that theirs names
for command, kinds in (
    (fly.fly, (*shipped.PARTS, "scenario")),
    (daemon.daemon, shipped.PARTS),
    (doctor.doctor, ()),
    (logs.score, ()),
    (logs.report, ()),
    (files.check, ()),
    (logs.identify, (*shipped.PARTS, "scenario")),
    (campaign.compare, (*shipped.PARTS, "scenario")),
    (campaign.campaign, ("campaign",)),
    (campaign.tune, ("tuning",)),
    (paper.paper, ()),
    (logs.replay, ()),
    (logs.export, ()),
    (files.key, ()),
):
    app.command(cls=Command, epilog=shipped.overview(*kinds))(command)
app.command("list", cls=Command)(files.list_files)
