"""The `offboard` command: one module for each of its commands, and what they share in `shared`."""

from __future__ import annotations

from typing import NoReturn

from offboard.documents.command_line import run


def main() -> NoReturn:
    """Run the command in `sys.argv` and exit. Errors of the user are printed as sentences."""
    run("offboard.cli.commands")
