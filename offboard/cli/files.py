"""The commands that read or make files: `offboard check`, `list` and `key`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from offboard.cli.shared import out, say, say_each
from offboard.documents import shipped
from offboard.documents.errors import DocumentError, UserError, naming, typed


def check(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Configuration files.")],
) -> None:
    """Check configuration files without flying.

    Accepts flight configurations, vehicles, controllers, scenarios, references (.yaml or .csv),
    campaigns and tunings. A reference must also be within the limits of the
    default vehicle, or of that of its configuration.

    Exit codes: 0 all files are valid; 2 one is not, or usage error.
    """
    problems = []
    for path in files:
        try:
            say(f"{path}: {_checked(path)}", indent=2)
        except DocumentError as error:
            problems.append(str(error))
    if problems:
        raise UserError("\n".join(problems))


def _checked(path: Path) -> str:
    """Validate a file and return the sentence for a valid one. The vehicle of the default
    configuration must be able to fly a reference; that of a configuration must be able to fly its
    reference. Raises DocumentError."""
    from offboard.campaign.cases import expand
    from offboard.campaign.document import CampaignFile
    from offboard.campaign.run import check as check_cases
    from offboard.campaign.tune import TuneFile, planned
    from offboard.documents.reading import kind_of, load_document, read
    from offboard.run.configuration import build_track, load, read_part
    from offboard.run.sitl import check_scenario

    table = path.suffix.lower() == ".csv"
    text = "" if table else shipped.read_text(path)
    kind = "reference" if table else kind_of(read(text, str(path)))
    name = str(path) if table else os.path.join(".", path)  # never the name of a shipped file
    if kind == "configuration":
        build_track(load(name))
    elif kind == "reference":
        flown = load("flight", choices={kind: name})
        build_track(flown)
        return f"{kind}, valid for the vehicle {flown.vehicle.name}"
    elif kind in shipped.PARTS:
        read_part(kind, name)
    elif kind == "scenario":
        check_scenario(text, str(path))
    elif kind == "tuning":
        tuning, source = load_document(name, "tuning", TuneFile)
        with naming(source):
            planned(tuning)
    elif kind == "campaign":
        campaign, source = load_document(name, "campaign", CampaignFile)
        with naming(source):
            check_cases(expand(campaign))
    else:
        raise DocumentError(
            f"{path}: no key says what it is: a vehicle has mass_kg, a controller law, a reference "
            "shape, a scenario conditions or faults, a configuration these three: "
            f"{', '.join(shipped.PARTS)}"
        )
    return f"{kind}, valid"


def list_files() -> None:
    """List the shipped files by name, with one line each."""
    from offboard.control import catalogue
    from offboard.documents.reading import descriptions

    for number, kind in enumerate(shipped.KINDS):
        described = descriptions(kind)
        if kind == "controller":
            for law in catalogue.names():
                described.setdefault(law, "law of an installed package")
        out.print("\n" * (number > 0) + f"{kind}s", style="bold")
        say_each(described)


DEFAULT = Path("offboard.key")


def key(
    file: Annotated[Path, typer.Argument(metavar="[FILE]", show_default=False)] = DEFAULT,
) -> None:
    """Make a key file for MAVLink signing.

    FILE is offboard.key unless it is named; what is printed says how a vehicle gets the key. The
    file holds a random passphrase of 64 characters; the key is its SHA-256, as in MAVProxy,
    QGroundControl and Mission Planner. Only you can read it, and no file is replaced.

    Exit codes: 0 done; 2 usage error, or a file that cannot be read or written.
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
    option = typed("--signing-key", file)
    say(f"Then: offboard fly {option}")
    say(f"or, without a vehicle: simulator {option}")
