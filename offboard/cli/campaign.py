"""`offboard campaign`: many flights on the bundled simulator, one table."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from offboard.cli.shared import CommandError, Workers, option, out, say
from offboard.documents.errors import UserError

if TYPE_CHECKING:
    from offboard.campaign.campaign import Campaign, OpenWorkers, Shard, Summary

EXIT_CODES = (
    "Exit codes: 0 all flights are flown and meet `require`, or --worst has found no failure; 1 a "
    "flight failed; 2 usage or configuration error; 4 flights are missing: the same command goes "
    "on."
)
NAME = typer.Argument(metavar="NAME|FILE", help="Campaign: a shipped name or a file.")
ENDED = "interrupted; finished flights are kept: run the same command again to go on"


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
        raise CommandError("--worst takes 1 .. 100, and no --shard: a search is one whole")
    if scheduler and workers:
        raise CommandError("--scheduler has its own workers: use it or --workers, not both")
    with out.status("planning"):
        from offboard.campaign.campaign import Campaign
        from offboard.campaign.document import read_campaign
        from offboard.campaign.execution import cluster_workers, local_workers

        part = _shard(shard)
        content, source = read_campaign(file)
        flown = Campaign(content, source, out_directory)
    open_workers: OpenWorkers = (
        partial(cluster_workers, scheduler) if scheduler else partial(local_workers, workers)
    )
    if worst is None:
        _conclude(_fly(flown, open_workers, part), out_directory)
    else:
        _search(flown, source, worst, open_workers)


def _shard(text: str | None) -> Shard:
    from offboard.campaign.campaign import Shard

    if text is None:
        return Shard()
    matched = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    if not matched or not 1 <= int(matched[1]) <= int(matched[2]):
        raise CommandError(f"--shard {text}: give I/N with I from 1 to N, for example 2/4")
    return Shard(int(matched[1]), int(matched[2]))


@contextmanager
def resumable() -> Iterator[None]:
    """Exit with 4 for an error after which the same command may go on, a full disk for example."""
    try:
        yield
    except UserError as error:
        raise CommandError(str(error), 4) from None


def _search(flown: Campaign, source: str, count: int, open_workers: OpenWorkers) -> None:
    """Search for failures and print them; exits with 1 if there is one."""
    from offboard.campaign.evaluate import Evaluator, Interrupted
    from offboard.campaign.progress import Counter
    from offboard.campaign.worst import keep, search_of
    from offboard.link.stop import StopRequests

    failures = None
    with (
        suppress(KeyboardInterrupt, Interrupted),
        StopRequests() as stops,
        open_workers() as workers,
        Counter(out) as counter,
    ):

        def progress(done: int) -> None:
            counter.count(done, max(done, most))

        evaluator = Evaluator(
            flown.results, flown.file.promises, workers, partial(counter.ending, stops), progress
        )
        search = search_of(flown, source, evaluator)
        most = search.flights_most(count)
        counter.count(0, most)
        with resumable():
            failures = search.find(count)
    if failures is None:
        raise CommandError(ENDED, 4)
    table = keep(failures, flown)
    flown.cases = list(evaluator.flown)
    flown.write(flown.rows())
    say(f"{len(evaluator.flown)} flights, {len(failures)} failures that differ")
    if failures:
        say(f"fly one again in {flown.directory}:")
    for failure in failures:
        changed = ", ".join(f"{key}={value:g}" for key, value in failure.changed)
        record = failure.record
        say(f"  {record.margin:.2f} {record.weakest}: {changed or 'nothing changed'}", indent=4)
        say(f"    {failure.failing} of {failure.seeds} other seeds fail: {failure.case.line}", 4)
    say(f"written: {table}")
    if failures:
        raise CommandError(f"{len(failures)} kinds of flights break a promise", 1)


def _fly(flown: Campaign, open_workers: OpenWorkers, part: Shard) -> Summary:
    from offboard.campaign.progress import Counter
    from offboard.link.stop import StopRequests

    summary: Summary | None = None
    with suppress(KeyboardInterrupt), StopRequests() as stops, Counter(out) as counter:
        summary = flown.fly(open_workers, part, partial(counter.ending, stops), counter.count)
    if summary is None:
        raise CommandError(ENDED, 4)
    return summary


def _conclude(summary: Summary, directory: Path) -> None:
    """Print what was flown; exits with 1 if a flight failed, 4 if some are missing."""
    flights = f"{len(summary.rows)} flights, {summary.failed} failed"
    if summary.missing:
        flights += f", {summary.missing} not flown yet"
    say(flights)
    say(f"written: {directory / 'campaign.html'}")
    if summary.stopped:
        raise CommandError(summary.stopped, 4)
    if summary.mine_missing:
        raise CommandError("interrupted: run the same command again to go on", 4)
    if summary.failed:
        raise CommandError(f"{summary.failed} flights failed; the table says why", 1)
