"""The typer application: registers all commands of `offboard`, and has the option `--version`."""

from __future__ import annotations

from importlib.metadata import version
from typing import Annotated

import typer

from offboard.cli import campaign, daemon, doctor, files, fly, logs, paper
from offboard.cli.shared import grouped, out, write
from offboard.documents import shipped
from offboard.documents.arguments import Command
from offboard.documents.command_line import USAGE

app = typer.Typer(invoke_without_command=True, add_completion=False, rich_markup_mode=None)


@app.callback()
def offboard(
    context: typer.Context,
    show_version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Fly a trajectory over MAVLink with a particle-swarm receding-horizon law, and score it."""
    if show_version:
        out.print(f"pso-offboard {version('pso-offboard')}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        write(f"{context.get_help()}\n")
        raise typer.Exit(USAGE)


# the commands in the order of --help; the help of each lists the shipped files of these kinds
for command, kinds in (
    (grouped(fly.fly), (*shipped.PARTS, "scenario")),
    (grouped(daemon.daemon), shipped.PARTS),
    (grouped(doctor.doctor), ()),
    (logs.score, ()),
    (logs.report, ()),
    (files.check, ()),
    (grouped(logs.identify), (*shipped.PARTS, "scenario")),
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
