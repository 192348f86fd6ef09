"""`offboard check`: configuration files validated without a flight."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from offboard.cli.shared import CommandError, say


def check(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Configuration files.")],
) -> None:
    """Check configuration files without flying.

    Accepts flight configurations, vehicles, controllers, scenarios and references (.yaml or .csv).
    A reference must also be within the limits of the vehicle.
    """
    from offboard.documents.errors import DocumentError
    from offboard.flight.configuration import check_file
    from offboard.flight.sitl import check_scenario

    problems = []
    for path in files:
        try:
            say(f"{path}: {check_file(path, check_scenario)}, valid", indent=2)
        except DocumentError as error:
            problems.append(str(error))
    if problems:
        raise CommandError("\n".join(problems))
