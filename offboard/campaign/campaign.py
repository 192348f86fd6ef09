"""A whole campaign: plan, fly what is not finished, write table and page.

The table is made of the folder of results alone, in the order of the plan. So it is the same
whether the flights were flown at once, in shards, on a cluster, or after an interruption.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from offboard.analysis.requirement import Requirement
from offboard.campaign.cases import Case, expand
from offboard.campaign.code import code_hash
from offboard.campaign.document import CampaignFile
from offboard.campaign.execution import Workers
from offboard.campaign.flight import Job
from offboard.campaign.page import CAMPAIGN, page
from offboard.campaign.results import Results
from offboard.campaign.statistics import groups
from offboard.campaign.table import Row, as_csv, columns, row_of
from offboard.documents.errors import DocumentError, UserError, naming
from offboard.run.configuration import build_controller, build_track
from offboard.run.in_memory import check_scenario_text
from offboard.run.request import FlightRequest

OpenWorkers = Callable[[], AbstractContextManager[Workers]]
KEPT = "flights"
KEPT_FILES = {"report": "report.html", "log": "flight.tlog"}


@dataclass(frozen=True, slots=True)
class Shard:
    """The part of the cases that one of several computers flies: `number` of `count`."""

    number: int = 1
    count: int = 1

    def of(self, cases: Sequence[Case]) -> list[Case]:
        """Every `count`-th case."""
        return list(cases[self.number - 1 :: self.count])


@dataclass(frozen=True, slots=True)
class Summary:
    """The state of a campaign. `stopped`: why flights are missing, if not by request."""

    planned: int
    rows: Sequence[Row]
    mine_missing: int
    stopped: str = ""

    @property
    def missing(self) -> int:
        return self.planned - len(self.rows)

    @property
    def failed(self) -> int:
        return sum(bool(row.failed) for row in self.rows)


class Campaign:
    """The campaign of a file in a directory.

    Raises DocumentError where nothing of it can be flown and UserError for a directory that
    cannot be used, before the first flight.
    """

    def __init__(self, file: CampaignFile, source: str, directory: Path) -> None:
        self.file = file
        self.directory = directory
        with naming(source):
            self.cases = expand(file)
            check(self.cases)
        self.results = Results(directory, code_hash())
        self._requirements = [Requirement.parse(text) for text in file.require]

    def fly(
        self,
        open_workers: OpenWorkers,
        shard: Shard,
        ending: Callable[[], bool],
        progress: Callable[[int, int], None],
    ) -> Summary:
        """Fly what is not finished and write the table. `progress` gets how many flights have
        ended, from 0 on, and how many were to be flown. Raises UserError where no worker can be
        had, or the table cannot be written."""
        mine = shard.of(self.cases)
        jobs = [
            Job(case, self.file.promises, code_hash())
            for case in mine
            if self.results.get(case.key) is None
        ]
        stopped = ""
        if jobs:
            progress(0, len(jobs))
            with open_workers() as workers:
                try:
                    for done, (job, record) in enumerate(workers.fly(jobs, ending), 1):
                        self.results.put(job.case.key, record)
                        progress(done, len(jobs))
                except UserError as error:
                    stopped = str(error)
        return self._conclude(mine, open_workers, ending, stopped)

    def _conclude(
        self,
        mine: Sequence[Case],
        open_workers: OpenWorkers,
        ending: Callable[[], bool],
        stopped: str,
    ) -> Summary:
        rows = self.rows()
        if len(rows) == len(self.cases) and not stopped:
            try:
                self._keep_worst(rows, open_workers, ending)
            except UserError as error:
                stopped = str(error)
        finished = -1
        while finished != self.results.finished():  # another shard may have ended meanwhile
            finished = self.results.finished()
            rows = self.rows()
            self.write(rows)
        have = {row.case.key for row in rows}
        missing = sum(case.key not in have for case in mine)
        return Summary(len(self.cases), rows, missing, stopped)

    def rows(self) -> list[Row]:
        """The finished flights of all shards, in the order of the plan."""
        found = ((case, self.results.get(case.key)) for case in self.cases)
        return [row_of(case, record, self._requirements) for case, record in found if record]

    def write(self, rows: Sequence[Row]) -> None:
        """Write table and page."""
        for case in self.cases:
            path = self.directory / case.scenario_file
            if case.text and not path.exists():
                self.results.write(path, case.text.encode())
        write = self.results.write
        write(self.directory / "campaign.csv", as_csv(columns(rows)).encode())
        absent = len(self.cases) - len(rows)
        missing = [f"{absent} of {len(self.cases)} flights are not flown yet"] if absent else []
        parts = (self.file.sample, self.file.search)
        drawn = frozenset(key for part in parts if part for key in part.ranges)
        text = page(
            groups(rows, drawn - self.file.parameters.keys()), CAMPAIGN, missing, self._kept(rows)
        )
        write(self.directory / "campaign.html", text.encode())

    def _keep_worst(
        self, rows: Sequence[Row], open_workers: OpenWorkers, ending: Callable[[], bool]
    ) -> None:
        """Fly the worst flights again, with their logs: the same seed gives the same flight."""
        flown = (row for row in rows if row.record.figures)
        worst = sorted(flown, key=lambda row: row.severity)[: self.file.kept]
        folders = [(row.case, self.directory / KEPT / row.case.key) for row in worst]
        jobs = [
            Job(case, self.file.promises, code_hash(), folder.absolute())
            for case, folder in folders
            if not folder.exists()
        ]
        if jobs:
            with open_workers() as workers:
                for _ in workers.fly(jobs, ending):
                    pass

    def _kept(self, rows: Sequence[Row]) -> dict[str, dict[str, str]]:
        """Files of kept flights by case, relative to the page."""
        if not self.file.kept:
            return {}
        return {
            row.case.key: {
                name: f"{KEPT}/{row.case.key}/{file}"
                for name, file in KEPT_FILES.items()
                if (self.directory / KEPT / row.case.key / file).exists()
            }
            for row in rows
        }


def check(cases: Sequence[Case]) -> None:
    """Raise DocumentError if none of the cases can be flown, with what is wrong. A single one that
    cannot is no error: it becomes a row with its reason."""
    distinct: dict[object, Case] = {}
    for case in cases:
        names = (case.config, case.controller, case.reference, case.vehicle, case.firmware)
        keys = tuple(key for key, _ in case.values)
        distinct.setdefault((*names, case.sim_vehicle, case.scenario, keys), case)
    problems: list[str] = []
    for case in distinct.values():
        try:
            _check_one(case)
        except DocumentError as error:
            problems += error.problems
        else:
            return
    raise DocumentError(*dict.fromkeys(problems))


def _check_one(case: Case) -> None:
    if case.text:
        check_scenario_text(case.text, f"scenario {case.scenario}")
    check_request(case.request(Path(), None if case.text else case.scenario))


def check_request(request: FlightRequest) -> None:
    """Raise DocumentError, with what is wrong, if a flight cannot be flown."""
    config = request.resolve()
    build_track(config)
    build_controller(config)
