"""A campaign flown: plan, fly what is not finished, write table and page from the folder of results
alone, in the order of the plan. `compare`, `--worst` and `tune` fly their cases in the same way
(`flying`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.status import Status

from offboard.analysis.score import Requirement
from offboard.campaign.cases import Case, expand
from offboard.campaign.document import CampaignFile, Promises
from offboard.campaign.flight import Job
from offboard.campaign.results import Record, Results, code_hash
from offboard.campaign.table import Row, as_csv, columns, groups, page, row_of
from offboard.campaign.workers import Flyer, OpenFlyer
from offboard.documents.errors import DocumentError, UserError, counted, naming
from offboard.link import clock
from offboard.link.stop import StopRequests
from offboard.run.flight import build
from offboard.run.sitl import check_scenario

TABLES = ("campaign.csv", "campaign.html", "worst.csv")  # that are replaced as flights end
KEPT = "flights"  # directory of the logs that are kept
KEPT_FILES = {"report": "report.html", "log": "flight.tlog"}
TABLE_S = 5.0  # at least, from one table to the next
TABLE_SHARE = 0.02  # of the time is for tables while it flies
INTERRUPTED = "interrupted: flights in the air are finished; interrupt again to exit at once"
LINES = 20
Fly = Callable[[Sequence[Case]], list[Record]]  # see `flying`


class Incomplete(UserError):
    """No further flight begins, for this `reason`, and the same command may go on."""

    def __init__(self, reason: str = "interrupted") -> None:
        super().__init__(f"{reason}: run the same command again to go on", 4)
        self.reason = reason


class Progress(Status):
    """Context manager that shows how many of at most `planned` flights have ended, how fast, and
    how long the rest takes: one line in place on a terminal, else a line at the beginning and for
    every twentieth of them."""

    def __init__(self, console: Console, planned: int = 0) -> None:
        super().__init__("", console=console)
        self.planned = planned
        self._begun_s = clock.monotonic_s()
        self._announced = False
        self._known = self._flown = 0

    def begin(self, known: int) -> None:
        """`known` further flights have been flown by an earlier run."""
        self._known += known
        if not self._flown:
            already = f", {self._known} already flown" if self._known else ""
            self._show(f"{counted(self.planned, 'flight')}{already}")

    def flight_ended(self) -> None:
        """A flight has ended."""
        self._flown += 1
        done = self._known + self._flown
        self.planned = max(self.planned, done)
        rate = 60.0 * self._flown / max(1e-9, clock.monotonic_s() - self._begun_s)
        left = remaining(60.0 * (self.planned - done) / rate)
        if self.console.is_terminal or done % max(1, self.planned // LINES) == 0:
            self._show(f"{done} of {self.planned} flights, {rate:.0f} a minute, {left} left")

    def ending(self, stops: StopRequests) -> bool:
        """Whether a stop was requested, which is then said, once."""
        if stops.requested and not self._announced:
            self._announced = True
            self.console.print(INTERRUPTED)
        return stops.requested

    def _show(self, line: str) -> None:
        if self.console.is_terminal:
            self.update(line)
        else:
            self.console.print(line, markup=False, soft_wrap=True)


def remaining(seconds: float) -> str:
    """A duration in the largest unit that gives two figures."""
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    minutes = seconds / 60.0
    return f"{minutes:.0f} min" if minutes < 100.0 else f"{minutes / 60.0:.1f} h"


@contextmanager
def flying(
    results: Results,
    promises: Promises,
    open_flyer: OpenFlyer,
    progress: Progress,
    *,
    keep: Path | None = None,
    written: Callable[[], None] = lambda: None,
) -> Iterator[Fly]:
    """A function that flies cases: what is in the folder of results is not flown again.

    It returns their records in their order. It raises Incomplete when one is missing, and UserError
    where no flight can begin. `open_flyer` is entered when the first case is missing. With `keep`,
    a directory, the log of each flight is kept in it. `written` is called after each flight.
    """
    folder = keep.absolute() if keep else None
    opened: list[Flyer] = []
    seen: set[str] = set()  # keys

    def is_done(case: Case, record: Record | None) -> bool:
        """With its log where logs are kept; the same seed gives the same flight again."""
        if record is None or folder is None or not record.figures:
            return record is not None
        return (folder / case.folder).exists()

    def fly(cases: Sequence[Case]) -> list[Record]:
        known = {case.key: results.get(case.key) for case in cases}
        missing = [case for case in cases if not is_done(case, known[case.key])]
        progress.begin(len(known.keys() - seen - {case.key for case in missing}))
        if missing and not opened:
            opened.append(stack.enter_context(open_flyer()))
        jobs = [
            Job(case, promises, code_hash(), folder / case.folder if folder else None)
            for case in missing
        ]
        try:
            for job, record in opened[0].fly(jobs, partial(progress.ending, stops)) if jobs else ():
                known[job.case.key] = record
                results.put(job.case.key, record)
                written()
                progress.flight_ended()
        except UserError as error:
            raise Incomplete(str(error)) from None
        records = [found for case in cases if (found := known[case.key]) is not None]
        if len(records) < len(cases):
            raise Incomplete
        seen.update(known)
        return records

    try:
        with StopRequests() as stops, progress, ExitStack() as stack:
            yield fly
    except KeyboardInterrupt:
        raise Incomplete from None


@dataclass(frozen=True, slots=True)
class Summary:
    """The state of a campaign. `mine_missing` of this shard; `stopped`: why no further flight
    began, empty if all did; `kept`: the directories of the flights whose logs are kept."""

    planned: int
    rows: Sequence[Row]
    mine_missing: int
    stopped: str
    kept: Sequence[Path]

    @property
    def missing(self) -> int:
        return self.planned - len(self.rows)

    @property
    def failed(self) -> int:
        return sum(bool(row.failed) for row in self.rows)


class Campaign:
    """The campaign of a file in a directory, on the simulator or at `link`.

    Raises DocumentError where nothing of it can be flown and UserError for a directory that cannot
    be used, before the first flight.
    """

    def __init__(
        self,
        file: CampaignFile,
        source: str,
        directory: Path,
        *,
        link: str | None = None,
    ) -> None:
        self.file = file
        self.directory = directory
        with naming(source):
            self.cases = expand(file, link)
            check(self.cases)
        taken = [name for name in TABLES if (directory / name).exists()]
        if taken and not (directory / "results").exists():
            raise UserError(
                f"{directory / taken[0]} exists, without results of a campaign beside it; choose "
                "another --out, or delete it"
            )
        self.results = Results(directory, code_hash())
        self._requirements = [Requirement.parse(text) for text in file.require]
        self._next_table_s = 0.0

    def flying(self, open_flyer: OpenFlyer, progress: Progress) -> AbstractContextManager[Fly]:
        """What flies cases for this campaign, and writes table and page while it does."""
        keep = self.directory / KEPT if self.file.keep else None
        return flying(
            self.results, self.file.promises, open_flyer, progress, keep=keep, written=self._written
        )

    def fly(self, open_flyer: OpenFlyer, console: Console, shard: slice = slice(None)) -> Summary:
        """Fly what is not finished and write the table. `shard`: the cases that are flown here.
        Raises UserError where no worker can be had."""
        mine = self.cases[shard]
        stopped = ""
        try:
            with self.flying(open_flyer, Progress(console, len(mine))) as fly:
                fly(mine)
        except Incomplete as error:
            stopped = error.reason
        finished = -1
        try:
            while finished != self.results.finished():  # another shard may have ended meanwhile
                finished = self.results.finished()
                rows = self.rows()
                self.write(rows, stopped)
        except UserError as error:
            stopped = stopped or str(error)
        have = {row.case.key for row in rows}
        missing = sum(case.key not in have for case in mine)
        folders = (self.directory / KEPT / row.case.folder for row in rows)
        kept = [path for path in folders if path.exists()]
        return Summary(len(self.cases), rows, missing, stopped, kept)

    def rows(self) -> list[Row]:
        """The finished flights of all shards, in the order of the plan."""
        found = ((case, self.results.get(case.key)) for case in self.cases)
        return [row_of(case, record, self._requirements) for case, record in found if record]

    @property
    def drawn(self) -> frozenset[str]:
        """The keys whose values are drawn or searched: they make no groups."""
        parts = (self.file.sample, self.file.search)
        keys = frozenset(key for part in parts if part for key in part.ranges)
        return keys - self.file.parameters.keys()

    def write(self, rows: Sequence[Row], stopped: str = "") -> None:
        """Write table and page."""
        write = self.results.write
        for case in self.cases:
            if (name := case.scenario_file) and not (path := self.directory / name).exists():
                write(path, case.scenario_text)
        write(self.directory / "campaign.csv", as_csv(columns(rows)))
        absent = len(self.cases) - len(rows)
        missing = [f"{absent} of {len(self.cases)} flights are not flown yet"] if absent else []
        missing += [stopped] if stopped else []
        text = page(groups(rows, self.drawn), missing, self._links)
        write(self.directory / "campaign.html", text)

    def _links(self, row: Row) -> dict[str, str]:
        """Files of a kept flight by name, relative to the page."""
        folder = Path(KEPT, row.case.folder)
        paths = {name: folder / file for name, file in KEPT_FILES.items()}
        return {name: str(path) for name, path in paths.items() if (self.directory / path).exists()}

    def _written(self) -> None:
        """Write what is known, rarely enough that it does not delay the flights."""
        now_s = clock.monotonic_s()
        if now_s >= self._next_table_s:
            self.write(self.rows())
            took_s = clock.monotonic_s() - now_s
            self._next_table_s = now_s + max(TABLE_S, took_s / TABLE_SHARE)


def check(cases: Sequence[Case]) -> None:
    """Raise DocumentError if none of the cases can be flown, with what is wrong. A single one that
    cannot is no error: it becomes a row with its reason."""
    distinct: dict[object, Case] = {}
    for case in cases:
        names = replace(case, values=(), seed=0)
        distinct.setdefault((names, *dict(case.values)), case)
    problems: list[str] = []
    for case in distinct.values():
        try:
            _check_one(case)
            return
        except DocumentError as error:
            problems += error.problems
    if problems:
        raise DocumentError(*dict.fromkeys(problems))


def _check_one(case: Case) -> None:
    if text := case.scenario_text:
        check_scenario(text, f"scenario {case.scenario}")
    case.simulated(None if text or case.link else case.scenario).check()
    build(case.load())
