"""Search over cases: the study behind `--worst` and `tune`, and the failures that `--worst` finds.

`--worst` searches for flights that break a promise, in different ways and by as few changed values
as possible. The flights are divided into rounds; a penalty keeps a round away from the failures of
earlier rounds. Then flights with a negative margin are reduced, the worst ones first: each value is
reset to its default, and stays there if the flight still fails. The weakest term and the values
that remain changed are the kind of the failure. The first K kinds are flown with more seeds.
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

Point = Mapping[str, float]  # key of a range -> value within it
BATCH = 20  # flights asked of the study before it is told their costs
ROUNDS = 4
AVOIDED = 6  # number of failures that a round avoids
NEAR = 0.25  # distance to a failure below which values are penalised (RMS of shares of the ranges)
PENALTY = 2.0  # added to the cost at the failure, less with distance
NO_FAILURE = 1.0  # cost of values that cannot be flown, which are no failure: the greatest margin
CANDIDATES = 3  # failures that are reduced per failure that is wanted


def study_of(seed: int) -> optuna.Study:
    """Create a study of optuna that minimises. Raises UserError without optuna."""
    try:
        import optuna
    except ImportError:
        raise UserError(f"a search needs optuna: {install('tune')}") from None
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    sampler = optuna.samplers.TPESampler(seed=seed, multivariate=True, constant_liar=True)
    return optuna.create_study(sampler=sampler)


def ask(study: optuna.Study, ranges: Mapping[str, Ends]) -> tuple[optuna.Trial, dict[str, float]]:
    """Return the trial and the values to try next, within `ranges` (key -> lowest, highest). The
    caller tells the study the cost of the trial."""
    trial = study.ask()
    asked = {
        key: trial.suggest_float(key, *ends, step=1.0 if key == SEED else None)
        for key, ends in ranges.items()
    }
    return trial, plain(asked, DIGITS)


@dataclass(frozen=True, slots=True)
class Failure:
    """A reduced failure. `changed` are the values that differ from their defaults; `failing` of
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
    """A search for failures around the only combination of a campaign. `source` names its file.

    The constructor raises DocumentError if the file declares no search or more than one
    combination, and UserError without optuna.
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
        # created before the first flight, so that a missing optuna is reported at once
        self._studies = [study_of(seed + 1000 * n) for n in range(ROUNDS)]
        middle = {key: (low + high) / 2 for key, (low, high) in ranges.items()}
        with naming(source):
            check([self._case(plain(middle, DIGITS))])

    def find(self, count: int, fly_cases: Fly) -> list[Failure]:
        """Return the worst failures of up to `count` different kinds. Writes worst.csv, and table
        and page of all flights. Raises Incomplete or UserError."""
        campaign, flown = self._campaign, dict[str, Case]()

        def fly(cases: Sequence[Case]) -> list[Record]:
            flown.update((case.key, case) for case in cases)
            return fly_cases(cases)

        failures: dict[tuple[str, tuple[str, ...]], Failure] = {}
        reduced = self._reduced(self._worst(self._flown(fly), CANDIDATES * count), fly)
        for failure in sorted(reduced, key=lambda each: each.record.margin):
            failures.setdefault(failure.kind, failure)
        found = self._at_seeds(list(failures.values())[:count], fly)
        campaign.cases = list(flown.values())
        campaign.write(campaign.rows())
        campaign.results.write(campaign.directory / "worst.csv", as_csv(found))
        return found

    def flights_most(self, count: int) -> int:
        """Return the greatest number of flights that `find` needs."""
        ranges, seeds = len(self._search.ranges), self._search.seeds
        return self._search.flights + count * (CANDIDATES * (1 + ranges) + seeds)

    def _flown(self, fly: Fly) -> list[tuple[Point, Record]]:
        """Fly all rounds of the search, each with its own study, and return the values with their
        records."""
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
        """Return the worst failures. Of failures with the same weakest term that are near each
        other, return only the worst."""
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
        """Return a change of a value as a share of its range."""
        low, high = self._search.ranges[key]
        return change / (high - low)

    def _distance(self, values: Point, other: Point) -> float:
        """Return the root mean square of the differences, as shares of the ranges."""
        shares = [self._share(key, value - other[key]) for key, value in values.items()]
        return math.hypot(*shares) / math.sqrt(len(shares))

    def _penalty(self, values: Point, failures: Sequence[Point]) -> float:
        nearest = min((self._distance(values, other) for other in failures), default=NEAR)
        return PENALTY * max(0.0, 1.0 - nearest / NEAR)

    def _reduced(self, points: Sequence[Point], fly: Fly) -> list[Failure]:
        """Reduce the failures at `points`, all in parallel: reset one value after the other to its
        default, those nearest to it first, and keep the default if the flight still fails."""
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
        """Fly each failure with further seeds, and return the failures with the results."""
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
        found: dict[str, float] = plain(middle | self._search.defaults, DIGITS)
        return found

    def _case(self, values: Point) -> Case:
        seed = round(values.get(SEED, self._base.seed))
        own = tuple((key, value) for key, value in values.items() if key != SEED)
        return replace(self._base, values=(*self._base.values, *own), seed=seed)


def as_csv(failures: Sequence[Failure]) -> str:
    """Return the failures as CSV, the worst first."""
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
