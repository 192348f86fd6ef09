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
        raise CommandError("\n".join(problems))


def _checked(path: Path) -> str:
    """Validate a file; what it is. Raises DocumentError."""
    from offboard.campaign.document import CampaignFile, read_campaign
    from offboard.campaign.tune import read_tune
    from offboard.documents.reading import read
    from offboard.documents.shipped import read_text
    from offboard.run.configuration import check_file
    from offboard.run.sitl import check_scenario

    keys = set() if path.suffix.lower() == ".csv" else set(read(read_text(path), str(path)))
    if keys & {"training", "validation"}:
        read_tune(str(path))
        return "tuning"
    if keys & CampaignFile.model_fields.keys() - {"config"}:
        read_campaign(str(path))
        return "campaign"
    return check_file(path, check_scenario)
