"""Flies a campaign: plans the cases, flies those that are not finished, and writes table and page
from the folder of results alone, in the order of the plan. `compare`, `--worst` and `tune` fly
their cases by the same function (`flying`)."""

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

TABLES = ("campaign.csv", "campaign.html", "worst.csv")  # files that a campaign overwrites
KEPT = "flights"  # directory of the logs that are kept
KEPT_FILES = {"report": "report.html", "log": "flight.tlog"}
TABLE_S = 5.0  # least time between two tables while flights run
TABLE_SHARE = 0.02  # greatest share of the time that is spent on tables while flights run
INTERRUPTED = "interrupted: flights in progress are finished first; interrupt again to exit at once"
LINES = 20
Fly = Callable[[Sequence[Case]], list[Record]]  # see `flying`


class Incomplete(UserError):
    """No further flight begins, for this `reason`; the same command can continue later."""

    def __init__(self, reason: str = "interrupted") -> None:
        super().__init__(f"{reason}: run the same command again to go on", 4)
        self.reason = reason


class Progress(Status):
    """Context manager that shows how many of at most `planned` flights have ended, the rate, and
    the time left. On a terminal this is one line that is updated; otherwise a line is printed at
    the beginning and after each twentieth part of the flights."""

    def __init__(self, console: Console, planned: int = 0) -> None:
        super().__init__("", console=console)
        self.planned = planned
        self._begun_s = clock.monotonic_s()
        self._announced = False
        self._known = self._flown = 0

    def begin(self, known: int) -> None:
        """Add `known` flights that an earlier run has flown."""
        self._known += known
        if not self._flown:
            already = f", {self._known} already flown" if self._known else ""
            self._show(f"{counted(self.planned, 'flight')}{already}")

    def flight_ended(self) -> None:
        """Count a flight that has ended, and update the line."""
        self._flown += 1
        done = self._known + self._flown
        self.planned = max(self.planned, done)
        rate = 60.0 * self._flown / max(1e-9, clock.monotonic_s() - self._begun_s)
        left = remaining(60.0 * (self.planned - done) / rate)
        if self.console.is_terminal or done % max(1, self.planned // LINES) == 0:
            self._show(f"{done} of {self.planned} flights, {rate:.0f} a minute, {left} left")

    def ending(self, stops: StopRequests) -> bool:
        """Return whether a stop was requested. The first time, print that it was."""
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
    """Return a duration as text, in the largest unit of s, min and h that gives two digits."""
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
    """Context manager that gives a function which flies cases.

    The function flies the cases that are not in the folder of results yet, and returns the records
    of all in their order. It raises Incomplete if one is missing, and UserError if no flight can
    begin. `open_flyer` is entered when the first flight is needed. `keep` is a directory in which
    the log of each flight is kept. `written` is called after each flight.
    """
    folder = keep.absolute() if keep else None
    opened: list[Flyer] = []
    seen: set[str] = set()  # keys of the cases of earlier calls

    def is_done(case: Case, record: Record | None) -> bool:
        """Whether a case need not be flown. If logs are kept, a flight without its log is flown
        again; the same seed gives the same flight. A case that was never flown has no log."""
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
    """The state of a campaign. `mine_missing` is the number of missing flights of this shard;
    `stopped` says why no further flight began, empty if all did; `kept` are the directories of the
    flights whose logs are kept."""

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
    """A campaign with its directory, flown on the simulator or at `link`. `source` names the file.

    The constructor raises DocumentError if no case can be flown, and UserError if the directory
    cannot be used.
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
        """Return `flying` for this campaign; it also writes table and page while flights run."""
        keep = self.directory / KEPT if self.file.keep else None
        return flying(
            self.results, self.file.promises, open_flyer, progress, keep=keep, written=self._written
        )

    def fly(self, open_flyer: OpenFlyer, console: Console, shard: slice = slice(None)) -> Summary:
        """Fly the cases that are not finished, and write table and page. `shard` selects the cases
        that this process flies. Raises UserError if no worker can be started."""
        mine = self.cases[shard]
        stopped = ""
        try:
            with self.flying(open_flyer, Progress(console, len(mine))) as fly:
                fly(mine)
        except Incomplete as error:
            stopped = error.reason
        finished = -1
        try:
            # again if another shard has finished flights in the meantime
            while finished != self.results.finished():
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
        """Return the finished flights of all shards, in the order of the plan."""
        found = ((case, self.results.get(case.key)) for case in self.cases)
        return [row_of(case, record, self._requirements) for case, record in found if record]

    @property
    def drawn(self) -> frozenset[str]:
        """The keys whose values are drawn or searched; flights are not grouped by them."""
        parts = (self.file.sample, self.file.search)
        keys = frozenset(key for part in parts if part for key in part.ranges)
        return keys - self.file.parameters.keys()

    def write(self, rows: Sequence[Row], stopped: str = "") -> None:
        """Write table, page and changed scenarios."""
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
        """Return the files of a kept flight by name; paths are relative to the page."""
        folder = Path(KEPT, row.case.folder)
        paths = {name: folder / file for name, file in KEPT_FILES.items()}
        return {name: str(path) for name, path in paths.items() if (self.directory / path).exists()}

    def _written(self) -> None:
        """Write table and page, but rarely enough not to delay the flights."""
        now_s = clock.monotonic_s()
        if now_s >= self._next_table_s:
            self.write(self.rows())
            took_s = clock.monotonic_s() - now_s
            self._next_table_s = now_s + max(TABLE_S, took_s / TABLE_SHARE)


def check(cases: Sequence[Case]) -> None:
    """Raise DocumentError with all problems if none of the cases can be flown. If only some cannot,
    that is no error: each becomes a row with its reason."""
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
