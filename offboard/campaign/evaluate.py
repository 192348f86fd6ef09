"""Cases flown in batches through a folder of results: what is finished is not flown again."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from offboard.campaign.cases import Case
from offboard.campaign.code import code_hash
from offboard.campaign.execution import Workers
from offboard.campaign.flight import Job
from offboard.campaign.margin import Promises
from offboard.campaign.results import Record, Results


class Interrupted(Exception):
    """No further flight begins."""


class Evaluator:
    """Flies cases and keeps their records. When `ending` is true, no further flight begins.
    `progress` gets the number of records known, after each flight."""

    def __init__(
        self,
        results: Results,
        promises: Promises,
        workers: Workers,
        ending: Callable[[], bool],
        progress: Callable[[int], None] = lambda known: None,
    ) -> None:
        self._results = results
        self._promises = promises
        self._workers = workers
        self._ending = ending
        self._progress = progress
        self.flown: dict[Case, Record] = {}

    def fly(self, cases: Sequence[Case]) -> list[Record]:
        """The records of these cases, in their order. Raises Interrupted, UserError, and what
        the workers raise."""
        known = {case: self._results.get(case.key) for case in cases}
        missing = [
            Job(case, self._promises, code_hash())
            for case, record in known.items()
            if record is None
        ]
        for job, record in self._workers.fly(missing, self._ending):
            self._results.put(job.case.key, record)
            known[job.case] = record
            self._progress(len(self.flown) + sum(each is not None for each in known.values()))
        found = [known[case] for case in cases]
        records = [record for record in found if record is not None]
        if len(records) < len(found):
            raise Interrupted
        self.flown.update(zip(cases, records, strict=True))
        return records
