"""`offboard key`: make a key file for MAVLink 2 signing."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from offboard.cli.shared import say

DEFAULT = Path("offboard.key")


def key(
    file: Annotated[Path, typer.Argument(metavar="[FILE]", show_default=False)] = DEFAULT,
) -> None:
    """Make a key file for MAVLink signing.

    FILE is offboard.key unless it is named; what is printed says how a vehicle gets the key. The
    file holds a random passphrase of 64 characters; the key is its SHA-256, as in MAVProxy,
    QGroundControl and Mission Planner. Only you can read it, and no file is replaced.
    """
    from offboard.documents.signing_key import create_key

    create_key(file)
    say(f"{file}: a new signing key, which only you can read. Keep it secret.")
    say("")
    say("Set it once on the vehicle, over a cable and disarmed (the passphrase is in the file):")
    say("  MAVProxy: signing setup PASSPHRASE", indent=4)
    say("  QGroundControl, Mission Planner: their page on MAVLink signing", indent=4)
    say("  It needs ArduPilot, or PX4 1.17 or later.", indent=4)
    say("")
    say(f"Then: offboard fly --signing-key {file}")
    say(f"or, without a vehicle: simulator --signing-key {file}")
