"""The search for failures: K flights that break a promise, differ, and are as simple as possible.

The budget is spent in rounds, by each method in turn. A round is kept away from the failures of
the rounds before it. Of the flights with a negative margin, worst first, each is reduced: values
return to their defaults one by one, as long as the flight still fails. What remains is its kind:
the weakest term and the values that had to be changed. The first K kinds are flown at more seeds.

All flights go through the folder of results, so that a search that was interrupted goes on.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from offboard.campaign.campaign import Campaign, check
from offboard.campaign.cases import SEED, Case, Values, rounded
from offboard.campaign.document import Search
from offboard.campaign.evaluate import Evaluator
from offboard.campaign.results import Record
from offboard.campaign.searchers import SEARCHERS
from offboard.campaign.table import as_csv as csv_of
from offboard.documents.errors import DocumentError, naming

Array = NDArray[np.float64]
BATCH = 20  # flights between two answers of a searcher
ROUND_BATCHES = 5  # at least, in a round
ROUNDS = 4
NEAR = 0.25  # of a range (root mean square): a point that is nearer to a failure is penalised
PENALTY = 2.0
CANDIDATES = 4  # failures that are reduced, per failure that is wanted


@dataclass(frozen=True, slots=True)
class Failure:
    """A failure that was reduced. `changed` holds its values that are not defaults; `failing` of
    `seeds` flights with other seeds fail, too."""

    case: Case
    record: Record
    changed: Values
    failing: int
    seeds: int

    @property
    def kind(self) -> tuple[str, tuple[str, ...]]:
        return self.record.weakest, tuple(key for key, _ in self.changed)


class FailureSearch:
    """Searches around the case `base`; `evaluator` flies."""

    def __init__(self, base: Case, search: Search, evaluator: Evaluator) -> None:
        self._base = base
        self._search = search
        self._evaluator = evaluator

    def find(self, count: int) -> list[Failure]:
        """The `count` worst failures that differ. Raises what `Evaluator.fly` raises."""
        found = self._candidates(list(self._searched()), CANDIDATES * count)
        candidates = [point for point, _ in found]
        failures: dict[tuple[str, tuple[str, ...]], Failure] = {}
        while candidates and len(failures) < count:
            together, candidates = candidates[:count], candidates[count:]
            for failure in self._reduced(together):
                failures.setdefault(failure.kind, failure)
        return self._at_seeds(list(failures.values())[:count])

    def flights_most(self, count: int) -> int:
        """The flights that `find` takes at most, unless it meets failures of the same kind."""
        ranges, seeds = len(self._search.ranges), self._search.seeds
        return self._search.flights + count * (1 + ranges + seeds)

    def middle(self) -> Case:
        """The case in the middle of all ranges."""
        return self._case(np.full(len(self._search.ranges), 0.5))

    # --- search ---

    def _searched(self) -> Iterator[tuple[Array, Record]]:
        """Every point that is flown, with its record."""
        batches = max(1, self._search.flights // BATCH)
        rounds = max(1, min(ROUNDS, batches // ROUND_BATCHES))
        failures: list[Array] = []
        searchers = [  # all before the first flight: one may need a package
            SEARCHERS[self._search.methods[number % len(self._search.methods)]](
                len(self._search.ranges), BATCH, self._search.seed + 1000 * number
            )
            for number in range(rounds)
        ]
        for number, searcher in enumerate(searchers):
            found: list[tuple[Array, Record]] = []
            for _ in range(batches * number // rounds, batches * (number + 1) // rounds):
                points = list(searcher.ask())
                records = self._evaluator.fly([self._case(point) for point in points])
                found += zip(points, records, strict=True)
                searcher.tell(
                    [
                        record.margin + _penalty(point, failures)
                        for point, record in zip(points, records, strict=True)
                    ]
                )
            yield from found
            failures += [p for p, _ in self._candidates(found, 2)]

    def _candidates(
        self, points: Sequence[tuple[Array, Record]], count: int
    ) -> list[tuple[Array, Record]]:
        """The worst failures that are not near each other."""
        chosen: list[tuple[Array, Record]] = []
        for point, record in sorted(points, key=lambda each: each[1].margin):
            near = any(
                _distance(point, other) < NEAR and record.weakest == known.weakest
                for other, known in chosen
            )
            if record.margin < 0.0 and not near and len(chosen) < count:
                chosen.append((point, record))
        return chosen

    # --- failures ---

    def _reduced(self, points: Sequence[Array]) -> list[Failure]:
        """The failures at `points`, reduced side by side: one flight of each at a time."""
        reductions = [self._reduction(point) for point in points]
        cases = [next(reduction) for reduction in reductions]
        failures: dict[int, Failure] = {}
        while len(failures) < len(points):
            active = [at for at in range(len(points)) if at not in failures]
            records = self._evaluator.fly([cases[at] for at in active])
            for at, record in zip(active, records, strict=True):
                try:
                    cases[at] = reductions[at].send(record)
                except StopIteration as done:
                    failures[at] = done.value
        return [failures[at] for at in range(len(points))]

    def _reduction(self, point: Array) -> Generator[Case, Record, Failure]:
        """Return values to their defaults, those that are nearest to them first. Yields the case to
        fly next, and takes its record."""
        chosen = dict(self._values(point))
        defaults = self._defaults()
        scale = {key: high - low for key, (low, high) in self._search.ranges.items()}

        def change(key: str) -> float:
            return float(abs(chosen[key] - defaults[key]) / scale[key])

        record = yield self._case_of(chosen)
        for key in sorted(chosen, key=change):
            trial = {**chosen, key: defaults[key]}
            shorter = yield self._case_of(trial)
            if shorter.margin < 0.0:
                chosen, record = trial, shorter
        changed = tuple((key, v) for key, v in chosen.items() if v != defaults[key])
        return Failure(self._case_of(chosen), record, changed, 0, 0)

    def _at_seeds(self, failures: Sequence[Failure]) -> list[Failure]:
        """The failures, each flown at `seeds` more seeds."""
        seeds = self._search.seeds
        records = self._evaluator.fly(
            [
                replace(each.case, seed=each.case.seed + more)
                for each in failures
                for more in range(1, seeds + 1)
            ]
        )
        return [
            replace(
                failure,
                failing=sum(r.margin < 0.0 for r in records[at * seeds : (at + 1) * seeds]),
                seeds=seeds,
            )
            for at, failure in enumerate(failures)
        ]

    # --- cases ---

    def _values(self, point: Array) -> Values:
        ranges = self._search.ranges.items()
        return tuple(
            (key, rounded(low + share * (high - low)))
            for (key, (low, high)), share in zip(ranges, point.tolist(), strict=True)
        )

    def _defaults(self) -> dict[str, float]:
        ranges = self._search.ranges
        middle = {
            key: 0.0 if low <= 0.0 <= high else (low + high) / 2
            for key, (low, high) in ranges.items()
        }
        if SEED in ranges:
            middle[SEED] = float(self._base.seed)
        return middle | self._search.defaults

    def _case(self, point: Array) -> Case:
        return self._case_of(dict(self._values(point)))

    def _case_of(self, values: dict[str, float]) -> Case:
        seed = round(values.get(SEED, self._base.seed))
        own = tuple((key, value) for key, value in values.items() if key != SEED)
        return replace(self._base.with_values((*self._base.values, *own)), seed=seed)


def search_of(campaign: Campaign, source: str, evaluator: Evaluator) -> FailureSearch:
    """The search of a campaign. Raises DocumentError where the file declares none, or more than
    one combination to search."""
    search = campaign.file.search
    if search is None:
        raise DocumentError(f"{source}: search is missing; --worst needs search.ranges")
    if len({replace(case, seed=0) for case in campaign.cases}) > 1 or campaign.file.sample:
        raise DocumentError(
            f"{source}: --worst searches around one combination; give one controller, reference, "
            "scenario, vehicle and firmware, one value of each parameter, and no sample"
        )
    found = FailureSearch(campaign.cases[0], search, evaluator)
    with naming(source):
        check([found.middle()])
    return found


def as_csv(failures: Sequence[Failure]) -> str:
    """The failures as CSV, the worst first."""
    return csv_of(
        {
            "margin": [each.record.margin for each in failures],
            "weakest": [each.record.weakest for each in failures],
            "failing": [each.failing for each in failures],
            "seeds": [each.seeds for each in failures],
            "changed": [" ".join(f"{k}={v:g}" for k, v in each.changed) for each in failures],
            "ended": [each.record.sentence for each in failures],
            "fly_again": [each.case.line for each in failures],
        }
    )


def keep(failures: Sequence[Failure], campaign: Campaign) -> Path:
    """Write worst.csv. Raises UserError."""
    table = campaign.directory / "worst.csv"
    campaign.results.write(table, as_csv(failures).encode())
    return table


def _distance(point: Array, other: Array) -> float:
    return float(np.sqrt(np.mean((point - other) ** 2)))


def _penalty(point: Array, failures: Sequence[Array]) -> float:
    nearest = min((_distance(point, other) for other in failures), default=NEAR)
    return PENALTY * max(0.0, 1.0 - nearest / NEAR)
