"""The `offboard` command: modules with its commands, and `shared` with what several of them use."""

from __future__ import annotations

from typing import NoReturn

from offboard.documents.command_line import run


def main() -> NoReturn:
    """Run the command in `sys.argv` and exit. An error that the user can fix is one sentence."""
    run("offboard.cli.commands")
