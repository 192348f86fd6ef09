"""`offboard compare`: several controllers flown and scored, side by side in one table."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

from offboard.cli.campaign import conclude
from offboard.cli.shared import (
    FLIGHTS,
    Assignments,
    Directory,
    SigningKey,
    System,
    Vehicle,
    Workers,
    option,
    out,
    say,
)
from offboard.documents import shipped
from offboard.documents.errors import UserError

if TYPE_CHECKING:
    from offboard.campaign.workers import OpenFlyer

EXIT_CODES = (
    "Exit codes: 0 all flights are completed; 1 a flight failed; 2 usage or configuration error; 4 "
    "flights are missing: the same command with --out DIR goes on."
)
NAMES = "Names or files, separated by commas"

SCENARIOS = "calm,px4_like"


def compare(
    controllers: Annotated[str, option("LIST", f"{NAMES}, or 'all'.")] = "pso,lqr,paper",
    reference: Annotated[str, option("LIST", f"{NAMES}.")] = "lemniscate",
    scenario: Annotated[str | None, option("LIST", f"{NAMES}.  [default: {SCENARIOS}]")] = None,
    seeds: Annotated[int, option("N", "Flights of each combination, with seeds 1 .. N.")] = 3,
    vehicle: Vehicle = None,
    connect: Annotated[
        str | None, option("LINK", "Fly the vehicle at this link instead of the simulator.")
    ] = None,
    system: System = None,
    signing_key: SigningKey = None,
    workers: Workers = None,
    out_directory: Directory = None,
    assignments: Assignments = None,
) -> None:
    """Fly several controllers and compare them in one table.

    Every controller flies every reference in every scenario with every seed: a campaign whose
    flights keep their logs. The table has medians and ranges; the directory gets campaign.csv and
    campaign.html. The same command with --out DIR continues what was interrupted.
    """
    if connect is None and (system or signing_key):
        raise UserError("--system and --signing-key are options of --connect: add it")
    if connect and (scenario or workers):
        raise UserError("--scenario and --workers are options of the simulator: omit them")
    if not 1 <= seeds <= 1000:
        raise UserError(f"--seeds {seeds}: give 1 .. 1000")
    laws = _names("--controllers", controllers, shipped.names("controller"))
    references = _names("--reference", reference)
    scenarios = ["connected"] if connect else _names("--scenario", scenario or SCENARIOS)
    say(
        f"controllers: {len(laws)}, references: {len(references)}, scenarios: {len(scenarios)}, "
        f"seeds: {seeds}"
    )
    with out.status("checking that all of them can be flown"):
        from offboard.campaign.document import CampaignFile
        from offboard.campaign.run import Campaign
        from offboard.campaign.workers import ConnectedVehicle, local_workers
        from offboard.link import clock

        file = CampaignFile(
            controllers=tuple(laws),
            references=tuple(references),
            scenarios=None if connect else tuple(scenarios),
            vehicles=(vehicle,) if vehicle else None,
            parameters=dict(map(_parameter, assignments or ())),
            seeds=seeds,
            keep=True,
        )
        directory = out_directory or FLIGHTS / f"compare-{clock.local_stamp()}"
        flown = Campaign(file, "compare", directory, link=connect)
    vehicle_at_link = ConnectedVehicle(system, signing_key)
    open_flyer: OpenFlyer = (
        (lambda: nullcontext(vehicle_at_link)) if connect else partial(local_workers, workers)
    )
    conclude(flown.fly(open_flyer, out), flown)


def _parameter(assignment: str) -> tuple[str, tuple[Any]]:
    """Key and value of `key.path=value`, as a campaign's parameter. Raises DocumentError."""
    from offboard.documents.reading import override

    value: Any = override({}, assignment)
    key = assignment.partition("=")[0]
    for part in key.split("."):
        value = value[part.strip()]
    return key, (value,)


def _names(name: str, text: str, known: Sequence[str] = ()) -> list[str]:
    """Comma-separated names, each once; 'all' stands for every known one."""
    parts = [part.strip() for part in text.split(",") if part.strip()]
    if not parts:
        raise UserError(f"{name} is an empty list of names; give at least one")
    return list(known) if parts == ["all"] and known else list(dict.fromkeys(parts))
