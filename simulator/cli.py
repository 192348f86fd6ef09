"""Console entry point of the `simulator` command, which is in `command`."""

from __future__ import annotations

from typing import NoReturn

from offboard.documents.command_line import run


def main() -> NoReturn:
    """Run the command in `sys.argv` and exit. A UserError is printed as a sentence."""
    run("simulator.command")
