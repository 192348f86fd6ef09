"""`offboard campaign`: many flights on the bundled simulator, one table."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from offboard.cli.shared import Workers, option, out, say
from offboard.documents.errors import UserError

if TYPE_CHECKING:
    from offboard.campaign.run import Campaign, Summary
    from offboard.campaign.workers import OpenFlyer

EXIT_CODES = (
    "Exit codes: 0 all flights are flown and meet `require`, or --worst has found no failure; 1 a "
    "flight failed; 2 usage or configuration error; 4 flights are missing: the same command goes "
    "on."
)
NAME = typer.Argument(metavar="NAME|FILE", help="Campaign: a shipped name or a file.")
GROUPS_SHOWN = 30  # of a table in the terminal


def campaign(
    file: Annotated[str, NAME],
    out_directory: Annotated[
        Path,
        option("DIR", "Directory of table, page and results; continued if it exists.", "--out"),
    ],
    workers: Workers = None,
    scheduler: Annotated[
        str | None, option("ADDRESS", "Fly on a dask cluster, for example tcp://HOST:8786.")
    ] = None,
    shard: Annotated[
        str | None, option("I/N", "Fly part I of N; the same --out, or copied together.")
    ] = None,
    worst: Annotated[int | None, option("K", "Search for K failures that differ instead.")] = None,
) -> None:
    """Fly many flights and put them into one table.

    DIR gets campaign.csv and campaign.html. A finished flight is
    on disk at once: the same command continues what was interrupted, and a table does not depend
    on how it was flown.

    --worst searches the ranges of `search` for flights with a negative margin, reduces each to the
    fewest changed values, and lists them in worst.csv with the command that flies each again.
    """
    if worst is not None and (shard or not 1 <= worst <= 100):
        raise UserError("--worst takes 1 .. 100, and no --shard: a search is one whole")
    if scheduler and workers:
        raise UserError("--scheduler has its own workers: use it or --workers, not both")
    with out.status("planning"):
        from offboard.campaign.document import read_campaign
        from offboard.campaign.run import Campaign
        from offboard.campaign.workers import cluster_workers, local_workers

        part = _shard(shard)
        content, source = read_campaign(file)
        flown = Campaign(content, source, out_directory)
    open_workers: OpenFlyer = (
        partial(cluster_workers, scheduler) if scheduler else partial(local_workers, workers)
    )
    if worst is None:
        conclude(flown.fly(open_workers, out, part), flown)
    else:
        _search(flown, source, worst, open_workers)


def _shard(text: str | None) -> slice:
    """The cases of shard I/N: every N-th."""
    if text is None:
        return slice(None)
    matched = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    if not matched or not 1 <= int(matched[1]) <= int(matched[2]):
        raise UserError(f"--shard {text}: give I/N with I from 1 to N, for example 2/4")
    return slice(int(matched[1]) - 1, None, int(matched[2]))


@contextmanager
def resumable() -> Iterator[None]:
    """Exit with 4 where the same command may go on: interrupted, a full disk for example."""
    from offboard.campaign.run import Incomplete

    try:
        yield
    except (Incomplete, KeyboardInterrupt) as reason:
        ended = str(reason) or "interrupted; finished flights are kept"
        raise UserError(f"{ended}: run the same command again to go on", 4) from None


def conclude(summary: Summary, flown: Campaign) -> None:
    """Print what was flown; exits with 1 if a flight failed, 4 if some are missing."""
    from offboard.campaign.table import groups, show

    directory = flown.directory
    found = groups(summary.rows, flown.drawn)
    if 0 < len(found) <= GROUPS_SHOWN:
        out.print()
        show(out, found)
    flights = f"{len(summary.rows)} flights, {summary.failed} failed"
    say(f"{flights}, {summary.missing} not flown yet" if summary.missing else flights)
    if summary.kept:
        say(f"kept: {len(summary.kept)} flights; `offboard report {summary.kept[0]}` shows one")
    say(f"written: {directory / 'campaign.csv'} and campaign.html")
    if summary.stopped or summary.mine_missing:
        why = summary.stopped or "interrupted"
        missing = f"{summary.mine_missing} of {summary.planned} flights are missing"
        raise UserError(f"{why}: {missing}; go on with the same command and --out {directory}", 4)
    if summary.failed:
        raise UserError(f"{summary.failed} flights failed; the table says why", 1)


def _search(flown: Campaign, source: str, count: int, open_workers: OpenFlyer) -> None:
    """Search for failures and print them; exits with 1 if there is one."""
    from offboard.campaign.progress import Counter
    from offboard.campaign.search import FailureSearch

    search = FailureSearch(flown, source)
    counter = Counter(out, search.flights_most(count))
    with resumable(), flown.runner(open_workers, counter) as runner:
        failures = search.find(count, runner)
    say(f"{len(flown.cases)} flights, {len(failures)} failures that differ")
    if failures:
        say(f"fly one again in {flown.directory}:")
    for failure in failures:
        changed = ", ".join(f"{key}={value:g}" for key, value in failure.changed)
        record = failure.record
        say(f"  {record.margin:.2f} {record.weakest}: {changed or 'nothing changed'}", indent=4)
        say(f"    {failure.failing} of {failure.seeds} other seeds fail: {failure.case.line}", 4)
    say(f"written: {flown.directory / 'worst.csv'} and campaign.html")
    if failures:
        raise UserError(f"{len(failures)} kinds of flights break a promise", 1)
