"""`offboard check`: configuration files validated without a flight."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from offboard.cli.shared import say
from offboard.documents.errors import UserError

EXIT_CODES = "Exit codes: 0 all files are valid; 2 one is not, or usage error."


def check(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Configuration files.")],
) -> None:
    """Check configuration files without flying.

    Accepts flight configurations, vehicles, controllers, scenarios, references (.yaml or .csv),
    campaigns and tunings. A reference must also be within the limits of the vehicle.
    """
    from offboard.documents.errors import DocumentError

    problems = []
    for path in files:
        try:
            say(f"{path}: {_checked(path)}, valid", indent=2)
        except DocumentError as error:
            problems.append(str(error))
    if problems:
        raise UserError("\n".join(problems))


def _checked(path: Path) -> str:
    """Validate a file; what it is. Raises DocumentError."""
    from offboard.campaign.document import read_campaign
    from offboard.campaign.tune import read_tune
    from offboard.documents.reading import kind_of, read
    from offboard.documents.shipped import read_text
    from offboard.run.configuration import check_file

    table = path.suffix.lower() == ".csv"
    kind = "" if table else kind_of(read(read_text(path), str(path)))
    if kind == "tuning":
        read_tune(str(path))
    elif kind == "campaign":
        read_campaign(str(path))
    else:
        return check_file(path)
    return kind
