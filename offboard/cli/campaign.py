"""The commands that fly many flights: `offboard campaign`, `compare` and `tune`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from offboard.cli.shared import (
    FLIGHTS,
    Assignments,
    Directory,
    SigningKey,
    System,
    Vehicle,
    Workers,
    absent,
    out,
    say,
    write_new,
)
from offboard.documents import shipped
from offboard.documents.arguments import FILE, option
from offboard.documents.errors import UserError, counted, typed

if TYPE_CHECKING:
    from offboard.campaign.run import Campaign, Summary
    from offboard.campaign.workers import OpenFlyer

NAMES = "Names or files, separated by commas"
SCENARIOS = "calm,px4_like"
PROFILE = ("-o", "--out")  # names of the option
GROUPS_SHOWN = 30  # a table with more rows is not printed in the terminal


def shard_of(text: str) -> slice:
    """The slice of all cases that selects shard I/N: every N-th case, beginning with case I.
    Raises BadParameter."""
    matched = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    if not matched or not 1 <= int(matched[1]) <= int(matched[2]):
        raise typer.BadParameter(f"{text!r}: give I/N with I from 1 to N, for example 2/4")
    return slice(int(matched[1]) - 1, None, int(matched[2]))


def campaign(
    file: Annotated[str, typer.Argument(metavar=FILE, help="Campaign: a shipped name or a file.")],
    out_directory: Annotated[
        Path,
        option("DIR", "Directory of table, page and results; continued if it exists.", "--out"),
    ],
    workers: Workers = None,
    scheduler: Annotated[
        str | None, option("ADDRESS", "Fly on a dask cluster, for example tcp://HOST:8786.")
    ] = None,
    shard: Annotated[
        slice | None,
        option("I/N", "Fly part I of N; the same --out, or copied together.", parser=shard_of),
    ] = None,
    worst: Annotated[
        int | None, option("K", "Search for K failures that differ instead.", min=1, max=100)
    ] = None,
) -> None:
    """Fly many flights and put them into one table.

    DIR gets campaign.csv and campaign.html. A finished flight is on disk at once: the same command
    continues what was interrupted, and a table does not depend on how it was flown.

    --worst searches the ranges of `search` for flights with a negative margin, reduces each to the
    fewest changed values, and lists them in worst.csv with the command that flies each again.

    Exit codes: 0 all flights are flown and meet `require`, or --worst has found no failure; 1 a
    flight failed; 2 usage or configuration error; 4 flights are missing: the same command goes
    on.
    """
    if worst and shard:
        raise UserError("--worst takes no --shard: a search cannot be divided")
    if scheduler and workers:
        raise UserError("--scheduler has its own workers: use it or --workers, not both")
    with out.status("planning"):
        from offboard.campaign.document import CampaignFile
        from offboard.campaign.run import Campaign
        from offboard.campaign.workers import cluster_workers, local_workers
        from offboard.documents.reading import load_document

        content, source = load_document(file, "campaign", CampaignFile)
        flown = Campaign(content, source, out_directory)
    open_workers: OpenFlyer = partial(local_workers, workers)
    if scheduler:
        open_workers = partial(cluster_workers, scheduler)
    if worst is None:
        conclude(flown.fly(open_workers, out, shard or slice(None)), flown)
    else:
        _search(flown, source, worst, open_workers)


def conclude(summary: Summary, flown: Campaign) -> None:
    """Print the results. Raises UserError, which exits with 1 if a flight failed, with 4 if flights
    are missing."""
    from offboard.campaign.table import groups, show

    directory = flown.directory
    found = groups(summary.rows, flown.drawn)
    if 0 < len(found) <= GROUPS_SHOWN:
        out.print()
        show(out, found)
    flights = f"{counted(len(summary.rows), 'flight')}, {summary.failed} failed"
    say(f"{flights}, {summary.missing} not flown yet" if summary.missing else flights)
    if summary.kept:
        kept = counted(len(summary.kept), "flight")
        say(f"kept: {kept}; `{typed('offboard', 'report', summary.kept[0])}` shows one")
    if (directory / "campaign.html").exists():  # else `stopped` says why
        say(f"written: {directory / 'campaign.csv'} and campaign.html")
    if summary.stopped or summary.mine_missing:
        why = summary.stopped or "interrupted"
        again = typed("--out", directory)
        are = "is" if summary.mine_missing == 1 else "are"
        missing = f"{summary.mine_missing} of {counted(summary.planned, 'flight')} {are} missing"
        raise UserError(f"{why}: {missing}; go on with the same command and {again}", 4)
    if summary.failed:
        raise UserError(f"{counted(summary.failed, 'flight')} failed; the table says why", 1)


def _search(flown: Campaign, source: str, count: int, open_workers: OpenFlyer) -> None:
    """Search for flights that fail and print them. Raises UserError, which exits with 1, if there
    is one."""
    from offboard.campaign.run import Progress
    from offboard.campaign.search import FailureSearch

    search = FailureSearch(flown, source)
    progress = Progress(out, search.flights_most(count))
    with flown.flying(open_workers, progress) as fly:
        failures = search.find(count, fly)
    unflown = sum(row.record.infeasible for row in flown.rows())
    cannot = f", {unflown} cannot be flown (the table says why)" if unflown else ""
    say(f"{len(flown.cases)} flights{cannot}, {len(failures)} failures that differ")
    if failures:
        say(f"fly one again in {flown.directory}:")
    for failure in failures:
        changed = ", ".join(f"{key}={value:g}" for key, value in failure.changed)
        record = failure.record
        say(f"  {record.margin:.2f} {record.weakest}: {changed or 'nothing changed'}", indent=4)
        say(f"    {failure.failing} of {failure.seeds} other seeds fail: {failure.case.line}", 4)
    say(f"written: {flown.directory / 'worst.csv'} and campaign.html")
    if failures:
        raise UserError(f"{len(failures)} different failures found", 1)


def compare(
    controllers: Annotated[str, option("LIST", f"{NAMES}, or 'all'.")] = "pso,lqr,paper",
    reference: Annotated[str, option("LIST", f"{NAMES}.")] = "lemniscate",
    scenario: Annotated[str | None, option("LIST", f"{NAMES}.  [default: {SCENARIOS}]")] = None,
    seeds: Annotated[
        int, option("N", "Flights of each combination, with seeds 1 .. N.", min=1, max=1000)
    ] = 3,
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

    Exit codes: 0 all flights are completed; 1 a flight failed; 2 usage or configuration error;
    4 flights are missing: the same command with --out DIR goes on.
    """
    if connect is None and (system or signing_key):
        raise UserError("--system and --signing-key are options of --connect: add it")
    if connect and (scenario or workers):
        raise UserError("--scenario and --workers are options of the simulator: omit them")
    laws = _names("--controllers", controllers, shipped.names("controller"))
    references = _names("--reference", reference)
    scenarios = _names("--scenario", scenario or SCENARIOS)
    with out.status("checking that all of them can be flown"):
        from offboard.campaign.document import CampaignFile
        from offboard.campaign.run import Campaign
        from offboard.campaign.workers import ConnectedVehicle, local_workers
        from offboard.documents.reading import assigned
        from offboard.link import clock
        from offboard.link.connection import parsed

        if connect:
            parsed(connect)  # a wrong address is refused before anything starts
        file = CampaignFile(
            controllers=tuple(laws),
            references=tuple(references),
            scenarios=None if connect else tuple(scenarios),
            vehicles=(vehicle,) if vehicle else None,
            parameters={key: (value,) for key, value in map(assigned, assignments or ())},
            seeds=tuple(range(1, seeds + 1)),
            keep=True,
        )
        directory = out_directory or FLIGHTS / f"compare-{clock.local_stamp()}"
        flown = Campaign(file, "compare", directory, link=connect)
    vehicle_at_link = ConnectedVehicle(system, signing_key)
    open_flyer: OpenFlyer = (
        (lambda: nullcontext(vehicle_at_link)) if connect else partial(local_workers, workers)
    )
    conclude(flown.fly(open_flyer, out), flown)


def _names(name: str, text: str, known: Sequence[str] = ()) -> list[str]:
    """The comma-separated names in `text`, each once; 'all' means all `known` names. `name` is the
    option. Raises UserError for an empty list."""
    parts = [part.strip() for part in text.split(",") if part.strip()]
    if not parts:
        raise UserError(f"{name} is an empty list of names; give at least one")
    return list(known) if parts == ["all"] and known else list(dict.fromkeys(parts))


def tune(
    file: Annotated[str, typer.Argument(metavar=FILE, help="Tuning: a shipped name or a file.")],
    profile: Annotated[
        Path,
        option("FILE", "Flight configuration to write; a new file.", *PROFILE, callback=absent),
    ] = Path("profile.yaml"),
    workers: Workers = None,
) -> None:
    """Tune parameters, and write a configuration that flies better.

    Minimises a metric over training flights, then flies the validation flights with and without
    the result. It is written only if it is better with 95 % confidence. The flights are in a
    folder beside it: the same command goes on. The shipped tuning shows all keys of the file.

    Exit codes: 0 a better configuration is written; 1 none is better; 2 usage or configuration
    error; 4 interrupted: the same command goes on.
    """
    with out.status("planning"):
        from offboard.campaign.document import Promises
        from offboard.campaign.results import Results, code_hash
        from offboard.campaign.run import Progress, flying
        from offboard.campaign.tune import TuneFile, Tuning
        from offboard.campaign.tune import profile as text_of
        from offboard.campaign.workers import local_workers
        from offboard.documents.reading import load_document

        tuning = Tuning(*load_document(file, "tuning", TuneFile))
        results = Results(profile.with_name(f"{profile.name}.tune"), code_hash())
    progress = Progress(out, tuning.flights)
    with flying(results, Promises(), partial(local_workers, workers), progress) as fly:
        tuned = tuning.run(
            fly,
            lambda number, cost: say(f"{number} of {tuning.file.trials} trials, best {cost:.4g}"),
        )
    for key, value in tuned.values:
        say(f"  {key}: {value:g}")
    say(f"validation: {tuned}")
    if not tuned.better:
        raise UserError("not better with 95 % confidence: nothing is written", 1)
    write_new(profile, text_of(tuning.file, tuned))
    say(f"written: {profile}")
