"""Search over cases: the study behind `--worst` and `tune`, and the failures that `--worst` finds.

Failures: flights that break a promise, differ, and are as simple as possible. The budget is spent
in rounds; a round is kept away from the failures of the rounds before it. Of the flights with a
negative margin, worst first, each is reduced: values return to their defaults one by one, as long
as the flight still fails. What remains is its kind: the weakest term and the values that had to be
changed. The first K kinds are flown at more seeds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from offboard.campaign.cases import DIGITS, SEED, Case, Values
from offboard.campaign.document import Ends
from offboard.campaign.results import Record
from offboard.campaign.run import Campaign, Fly, check
from offboard.campaign.table import as_csv as csv_of
from offboard.documents.errors import DocumentError, UserError, install, naming, plain

if TYPE_CHECKING:
    import optuna

Point = Mapping[str, float]  # a value within each range
BATCH = 20  # flights between two answers of the study
ROUNDS = 4
AVOIDED = 6  # failures that a round is kept away from
NEAR = 0.25  # of a range (root mean square): values that are nearer to a failure are penalised
PENALTY = 2.0
NO_FAILURE = 1.0  # greatest margin: of values that cannot be flown, which are no failure
CANDIDATES = 3  # failures that are reduced, per failure that is wanted


def study_of(seed: int) -> optuna.Study:
    """A study of optuna, which minimises. Raises UserError without optuna."""
    try:
        import optuna
    except ImportError:
        raise UserError(f"a search needs optuna: {install('tune')}") from None
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    sampler = optuna.samplers.TPESampler(seed=seed, multivariate=True, constant_liar=True)
    return optuna.create_study(sampler=sampler)


def ask(study: optuna.Study, ranges: Mapping[str, Ends]) -> tuple[optuna.Trial, dict[str, float]]:
    """The next values to try within `ranges` (key -> lowest, highest), and the trial that is to be
    told what they cost."""
    trial = study.ask()
    asked = {key: trial.suggest_float(key, *ends) for key, ends in ranges.items()}
    return trial, plain(asked, DIGITS)


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
    """The search of a campaign, whose file is `source`, around its one combination.

    Raises DocumentError where the file declares no search, or more than one combination, and
    UserError without optuna.
    """

    def __init__(self, campaign: Campaign, source: str) -> None:
        if campaign.file.search is None:
            raise DocumentError(f"{source}: search is missing; --worst needs search.ranges")
        if len({replace(case, seed=0).key for case in campaign.cases}) > 1 or campaign.file.sample:
            raise DocumentError(
                f"{source}: --worst searches around one combination; give one controller, "
                "reference, scenario, vehicle and firmware, one value of each parameter, and no "
                "sample"
            )
        self._campaign = campaign
        self._base, self._search = campaign.cases[0], campaign.file.search
        ranges, seed = self._search.ranges, self._search.seed
        # all before the first flight: a study needs a package
        self._studies = [study_of(seed + 1000 * n) for n in range(ROUNDS)]
        middle = {key: (low + high) / 2 for key, (low, high) in ranges.items()}
        with naming(source):
            check([self._case(plain(middle, DIGITS))])

    def find(self, count: int, fly_cases: Fly) -> list[Failure]:
        """The `count` worst failures that differ; writes worst.csv, and table and page of all
        flights. Raises Incomplete, or UserError."""
        campaign, flown = self._campaign, dict[str, Case]()

        def fly(cases: Sequence[Case]) -> list[Record]:
            flown.update((case.key, case) for case in cases)
            return fly_cases(cases)

        failures: dict[tuple[str, tuple[str, ...]], Failure] = {}
        for failure in self._reduced(self._worst(self._flown(fly), CANDIDATES * count), fly):
            failures.setdefault(failure.kind, failure)
        found = self._at_seeds(list(failures.values())[:count], fly)
        campaign.cases = list(flown.values())
        campaign.write(campaign.rows())
        campaign.results.write(campaign.directory / "worst.csv", as_csv(found))
        return found

    def flights_most(self, count: int) -> int:
        """The flights that `find` takes at most."""
        ranges, seeds = len(self._search.ranges), self._search.seeds
        return self._search.flights + count * (CANDIDATES * (1 + ranges) + seeds)

    def _flown(self, fly: Fly) -> list[tuple[Point, Record]]:
        """All values that are flown, with their records. Each round has a study of its own and is
        kept away from the failures of the rounds before it."""
        flown: list[tuple[Point, Record]] = []
        for study in self._studies:
            failures = self._worst(flown, AVOIDED)
            for _ in range(self._search.flights // (ROUNDS * BATCH)):
                asked = [ask(study, self._search.ranges) for _ in range(BATCH)]
                records = fly([self._case(values) for _, values in asked])
                for (trial, values), record in zip(asked, records, strict=True):
                    cost = NO_FAILURE if record.infeasible else record.margin
                    study.tell(trial, cost + self._penalty(values, failures))
                    flown.append((values, record))
        return flown

    def _worst(self, flown: Sequence[tuple[Point, Record]], count: int) -> list[Point]:
        """The worst failures that are not near each other."""
        chosen: list[tuple[Point, Record]] = []
        for values, record in sorted(flown, key=lambda each: each[1].margin):
            near = any(
                self._distance(values, other) < NEAR and record.weakest == known.weakest
                for other, known in chosen
            )
            if record.breaks_a_promise and not near and len(chosen) < count:
                chosen.append((values, record))
        return [values for values, _ in chosen]

    def _share(self, key: str, change: float) -> float:
        """A change of a value as a share of its range."""
        low, high = self._search.ranges[key]
        return change / (high - low)

    def _distance(self, values: Point, other: Point) -> float:
        """Root mean square of the differences, as shares of the ranges."""
        shares = [self._share(key, value - other[key]) for key, value in values.items()]
        return math.hypot(*shares) / math.sqrt(len(shares))

    def _penalty(self, values: Point, failures: Sequence[Point]) -> float:
        nearest = min((self._distance(values, other) for other in failures), default=NEAR)
        return PENALTY * max(0.0, 1.0 - nearest / NEAR)

    def _reduced(self, points: Sequence[Point], fly: Fly) -> list[Failure]:
        """The failures at `points`, reduced side by side: values return to their defaults, those
        that are nearest to them first, as long as the flight still fails."""
        defaults, reduced = self._defaults(), [*points]

        def order(point: Point) -> list[str]:
            return sorted(point, key=lambda key: abs(self._share(key, point[key] - defaults[key])))

        orders = [order(point) for point in points]
        records = fly([self._case(values) for values in reduced])
        for keys in zip(*orders, strict=True):
            trials = [
                {**values, key: defaults[key]} for values, key in zip(reduced, keys, strict=True)
            ]
            for at, record in enumerate(fly([self._case(values) for values in trials])):
                if record.breaks_a_promise:
                    reduced[at], records[at] = trials[at], record
        found = []
        for values, record in zip(reduced, records, strict=True):
            changed = tuple((k, value) for k, value in values.items() if value != defaults[k])
            found.append(Failure(self._case(values), record, changed, 0, 0))
        return found

    def _at_seeds(self, failures: Sequence[Failure], fly: Fly) -> list[Failure]:
        """The failures, each flown at `seeds` more seeds."""
        found = []
        for failure in failures:
            case = failure.case
            seeds = range(case.seed + 1, case.seed + 1 + self._search.seeds)
            records = fly([replace(case, seed=seed) for seed in seeds])
            failing = sum(record.breaks_a_promise for record in records)
            found.append(replace(failure, failing=failing, seeds=len(records)))
        return found

    def _defaults(self) -> dict[str, float]:
        ranges = self._search.ranges
        middle = {
            key: 0.0 if low <= 0.0 <= high else (low + high) / 2
            for key, (low, high) in ranges.items()
        }
        if SEED in ranges:
            middle[SEED] = float(self._base.seed)
        return middle | self._search.defaults

    def _case(self, values: Point) -> Case:
        seed = round(values.get(SEED, self._base.seed))
        own = tuple((key, value) for key, value in values.items() if key != SEED)
        return replace(self._base, values=(*self._base.values, *own), seed=seed)


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
