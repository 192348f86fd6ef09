"""Search over cases: the study behind `--worst` and `tune`, and the failures that `--worst` finds.

A study (optuna's TPE sampler) asks for values in batches and is told what they cost. It is in
memory: the same seed asks the same values, and the folder of results has the flights, so that a
search that was interrupted goes on.

Failures: flights that break a promise, differ, and are as simple as possible. The budget is spent
in rounds; a round is kept away from the failures of the rounds before it. Of the flights with a
negative margin, worst first, each is reduced: values return to their defaults one by one, as long
as the flight still fails. What remains is its kind: the weakest term and the values that had to be
changed. The first K kinds are flown at more seeds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from offboard.campaign.cases import SEED, Case, Values, rounded
from offboard.campaign.document import Search
from offboard.campaign.results import Record
from offboard.campaign.run import Campaign, Runner, check
from offboard.campaign.table import as_csv as csv_of
from offboard.documents.errors import DocumentError, UserError, naming
from offboard.documents.extras import install

Fly = Callable[[Sequence[Case]], list[Record]]  # `Runner.fly`
BATCH = 20  # flights between two answers of the study
ROUND_BATCHES = 5  # at least, in a round
ROUNDS = 4
NEAR = 0.25  # of a range (root mean square): values that are nearer to a failure are penalised
PENALTY = 2.0
CANDIDATES = 4  # failures that are reduced, per failure that is wanted


class Study:
    """Minimises a cost over `ranges` (key -> lowest, highest). Raises UserError without optuna.

    Example:

        study = Study({"controller.bandwidth_radps": (3.0, 9.0)}, seed=1)
        study.tell([cost(dict(values)) for values in study.ask(20)])
        print(study.best)
    """

    def __init__(self, ranges: Mapping[str, tuple[float, float]], seed: int) -> None:
        try:
            import optuna
        except ImportError:
            raise UserError(f"a search needs optuna: {install('tune')}") from None
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        sampler = optuna.samplers.TPESampler(seed=seed, multivariate=True, constant_liar=True)
        self._study = optuna.create_study(sampler=sampler)
        self._ranges = ranges
        self._asked: list[optuna.Trial] = []

    def first(self, values: Mapping[str, float]) -> None:
        """Ask these values first, as far as they are within the ranges."""
        within = {
            key: value
            for key, value in values.items()
            if self._ranges[key][0] <= value <= self._ranges[key][1]
        }
        self._study.enqueue_trial(within)

    def ask(self, count: int = 1) -> list[Values]:
        """The next values to try."""
        self._asked = [self._study.ask() for _ in range(count)]
        return [
            tuple(
                (key, rounded(trial.suggest_float(key, *ends)))
                for key, ends in self._ranges.items()
            )
            for trial in self._asked
        ]

    def tell(self, costs: Sequence[float]) -> None:
        """What those that were asked last cost, in their order."""
        for trial, cost in zip(self._asked, costs, strict=True):
            self._study.tell(trial, cost)

    @property
    def best(self) -> tuple[Values, float]:
        """The values with the lowest cost, and this cost."""
        found = self._study.best_trial
        assert found.value is not None
        return tuple((key, rounded(found.params[key])) for key in self._ranges), found.value


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
    """Searches around the case `base`."""

    def __init__(self, base: Case, search: Search) -> None:
        self._base = base
        self._search = search
        batches = max(1, search.flights // BATCH)
        rounds = max(1, min(ROUNDS, batches // ROUND_BATCHES))
        self._batches = [batches * (n + 1) // rounds - batches * n // rounds for n in range(rounds)]
        # all before the first flight: a study needs a package
        self._studies = [Study(search.ranges, search.seed + 1000 * n) for n in range(rounds)]

    def find(self, count: int, fly: Fly) -> list[Failure]:
        """The `count` worst failures that differ. Raises what `fly` raises."""
        found = self._candidates(list(self._searched(fly)), CANDIDATES * count)
        candidates = [values for values, _ in found]
        failures: dict[tuple[str, tuple[str, ...]], Failure] = {}
        while candidates and len(failures) < count:
            together, candidates = candidates[:count], candidates[count:]
            for failure in self._reduced(together, fly):
                failures.setdefault(failure.kind, failure)
        return self._at_seeds(list(failures.values())[:count], fly)

    def flights_most(self, count: int) -> int:
        """The flights that `find` takes at most, unless it meets failures of the same kind."""
        ranges, seeds = len(self._search.ranges), self._search.seeds
        return self._search.flights + count * (1 + ranges + seeds)

    def middle(self) -> Case:
        """The case in the middle of all ranges."""
        return self._case(
            tuple((key, rounded((a + b) / 2)) for key, (a, b) in self._search.ranges.items())
        )

    # --- search ---

    def _searched(self, fly: Fly) -> Iterator[tuple[Values, Record]]:
        """All values that are flown, with their records."""
        failures: list[Values] = []
        for study, batches in zip(self._studies, self._batches, strict=True):
            found: list[tuple[Values, Record]] = []
            for _ in range(batches):
                asked = study.ask(BATCH)
                records = fly([self._case(values) for values in asked])
                found += zip(asked, records, strict=True)
                study.tell(
                    [
                        record.margin + self._penalty(values, failures)
                        for values, record in zip(asked, records, strict=True)
                    ]
                )
            yield from found
            failures += [values for values, _ in self._candidates(found, 2)]

    def _candidates(
        self, flown: Sequence[tuple[Values, Record]], count: int
    ) -> list[tuple[Values, Record]]:
        """The worst failures that are not near each other."""
        chosen: list[tuple[Values, Record]] = []
        for values, record in sorted(flown, key=lambda each: each[1].margin):
            near = any(
                self._distance(values, other) < NEAR and record.weakest == known.weakest
                for other, known in chosen
            )
            if record.margin < 0.0 and not near and len(chosen) < count:
                chosen.append((values, record))
        return chosen

    def _distance(self, values: Values, other: Values) -> float:
        """Root mean square of the differences, as shares of the ranges."""
        shares = [
            (value - second) / (high - low)
            for (_, value), (_, second), (low, high) in zip(
                values, other, self._search.ranges.values(), strict=True
            )
        ]
        return math.hypot(*shares) / math.sqrt(len(shares))

    def _penalty(self, values: Values, failures: Sequence[Values]) -> float:
        nearest = min((self._distance(values, other) for other in failures), default=NEAR)
        return PENALTY * max(0.0, 1.0 - nearest / NEAR)

    # --- failures ---

    def _reduced(self, points: Sequence[Values], fly: Fly) -> list[Failure]:
        """The failures at `points`, reduced side by side: one flight of each at a time."""
        reductions = [self._reduction(point) for point in points]
        cases = [next(reduction) for reduction in reductions]
        failures: dict[int, Failure] = {}
        while len(failures) < len(points):
            active = [at for at in range(len(points)) if at not in failures]
            records = fly([cases[at] for at in active])
            for at, record in zip(active, records, strict=True):
                try:
                    cases[at] = reductions[at].send(record)
                except StopIteration as done:
                    failures[at] = done.value
        return [failures[at] for at in range(len(points))]

    def _reduction(self, point: Values) -> Generator[Case, Record, Failure]:
        """Return values to their defaults, those that are nearest to them first. Yields the case to
        fly next, and takes its record."""
        chosen = dict(point)
        defaults = self._defaults()
        scale = {key: high - low for key, (low, high) in self._search.ranges.items()}

        def change(key: str) -> float:
            return float(abs(chosen[key] - defaults[key]) / scale[key])

        record = yield self._case(tuple(chosen.items()))
        for key in sorted(chosen, key=change):
            trial = {**chosen, key: defaults[key]}
            shorter = yield self._case(tuple(trial.items()))
            if shorter.margin < 0.0:
                chosen, record = trial, shorter
        changed = tuple((key, v) for key, v in chosen.items() if v != defaults[key])
        return Failure(self._case(tuple(chosen.items())), record, changed, 0, 0)

    def _at_seeds(self, failures: Sequence[Failure], fly: Fly) -> list[Failure]:
        """The failures, each flown at `seeds` more seeds."""
        seeds = self._search.seeds
        records = fly(
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

    def _defaults(self) -> dict[str, float]:
        ranges = self._search.ranges
        middle = {
            key: 0.0 if low <= 0.0 <= high else (low + high) / 2
            for key, (low, high) in ranges.items()
        }
        if SEED in ranges:
            middle[SEED] = float(self._base.seed)
        return middle | self._search.defaults

    def _case(self, values: Values) -> Case:
        seed = round(dict(values).get(SEED, self._base.seed))
        own = tuple((key, value) for key, value in values if key != SEED)
        return replace(self._base.with_values((*self._base.values, *own)), seed=seed)


def search_of(campaign: Campaign, source: str) -> FailureSearch:
    """The search of a campaign. Raises DocumentError where the file declares none, or more than
    one combination to search."""
    search = campaign.file.search
    if search is None:
        raise DocumentError(f"{source}: search is missing; --worst needs search.ranges")
    if len({replace(case, seed=0).key for case in campaign.cases}) > 1 or campaign.file.sample:
        raise DocumentError(
            f"{source}: --worst searches around one combination; give one controller, reference, "
            "scenario, vehicle and firmware, one value of each parameter, and no sample"
        )
    found = FailureSearch(campaign.cases[0], search)
    with naming(source):
        check([found.middle()])
    return found


def find(campaign: Campaign, search: FailureSearch, count: int, runner: Runner) -> list[Failure]:
    """The `count` worst failures that differ; writes worst.csv, and table and page of all flights.
    Raises Incomplete, or UserError."""
    failures = search.find(count, runner.fly)
    campaign.cases = list(runner.flown.values())
    campaign.write(campaign.rows())
    campaign.results.write(campaign.directory / "worst.csv", as_csv(failures).encode())
    return failures


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
