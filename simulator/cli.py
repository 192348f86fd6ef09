"""Console entry point of the `simulator` command, which is in `command`."""

from __future__ import annotations

from offboard.documents.command_line import run

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import NoReturn


def main() -> NoReturn:
    """Run the command in `sys.argv` and exit. Errors of the user are printed as sentences."""
    run("simulator.command")
