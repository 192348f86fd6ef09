"""Tuning: finds parameters that lower a metric on training flights, and tests on validation flights
whether they are better. The test compares pairs of flights with the same scenario and seed.

    ranges:
      controller.bandwidth_radps: [3, 9]
    training: {scenarios: [px4_like, gusts], seeds: 3}
    validation: {scenarios: [all_together, wind_2mps], seeds: 10}
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import yaml
from pydantic import AfterValidator, Field
from scipy import stats

from offboard.campaign.cases import DIGITS, SCENARIO, Case, Values, expand
from offboard.campaign.document import CampaignFile, Ends, Firmware, Key, Name, Names, Seed, Seeds
from offboard.campaign.run import Fly, check
from offboard.campaign.search import ask, study_of
from offboard.campaign.table import CONFIDENCE, METRIC_COLUMNS
from offboard.documents.errors import DocumentError, naming, plain
from offboard.documents.parameters import Parameters
from offboard.documents.reading import override, read
from offboard.documents.shipped import PARTS, locate, read_text
from offboard.run.configuration import read_part


def _metric(name: str) -> str:
    if name not in METRIC_COLUMNS:
        known = ", ".join(METRIC_COLUMNS)
        raise ValueError(f"{name!r} is no metric of a lockstep flight; there are {known}")
    return name


def _tuned(key: str) -> str:
    if key.startswith((SCENARIO, "vehicle.")):
        raise ValueError("no scenario and no vehicle is tuned")
    return key


class Flights(Parameters):
    """A set of flights: every reference in every scenario with every seed."""

    references: Names | None = None
    scenarios: Names
    seeds: Seeds = (1, 2, 3)


class TuneFile(Parameters):
    """A tuning. `objective` is the metric whose mean over the flights is minimised; a flight that
    is not completed counts as `failure`."""

    config: Name = "flight"
    controller: Name | None = None
    firmware: Firmware = "px4"
    ranges: Annotated[dict[Annotated[Key, AfterValidator(_tuned)], Ends], Field(min_length=1)]
    training: Flights
    validation: Flights
    objective: Annotated[str, AfterValidator(_metric)] = "rmse_position_m"
    failure: float = Field(default=5.0, gt=0, le=1e6)
    trials: int = Field(default=60, ge=2, le=100_000)
    seed: Seed = 1


@dataclass(frozen=True, slots=True)
class Tuned:
    """The best parameters found (`values`), and the mean cost of the validation flights without
    (`base`) and with them (`candidate`). `p_value` is that of Wilcoxon's one-sided signed-rank
    test."""

    values: Values
    flights: int
    base: float
    candidate: float
    p_value: float

    @property
    def better(self) -> bool:
        """Whether the mean is lower, and significantly so at CONFIDENCE."""
        return self.candidate < self.base and self.p_value < 1.0 - CONFIDENCE

    def __str__(self) -> str:
        return (
            f"mean cost {self.base:.4g} before, {self.candidate:.4g} after, "
            f"p = {self.p_value:.2g}, {self.flights} flights each"
        )


def judge(base: Sequence[float], candidate: Sequence[float], values: Values = ()) -> Tuned:
    """Compare the costs of paired flights (same scenario, same seed)."""
    before, after = np.asarray(base, float), np.asarray(candidate, float)
    p_value = 1.0
    if np.any(after != before):
        p_value = float(stats.wilcoxon(after, before, alternative="less").pvalue)
    return Tuned(values, len(before), float(before.mean()), float(after.mean()), p_value)


class Tuning:
    """Finds and tests parameters. The constructor raises DocumentError if the flights cannot be
    flown, and UserError without optuna."""

    def __init__(self, file: TuneFile, source: str) -> None:
        self.file = file
        self._study = study_of(file.seed)
        with naming(source):
            self._training, self._validation, self._defaults = planned(file)
            for key, ends in file.ranges.items():
                for end in ends:
                    replace(self._training[0], values=((key, end),)).load()
            check([self._training[0]])

    @property
    def flights(self) -> int:
        """The number of flights of the tuning."""
        return self.file.trials * len(self._training) + 2 * len(self._validation)

    def run(self, fly: Fly, progress: Callable[[int, float], None]) -> Tuned:
        """Search on the training flights, then fly the validation flights without and with the
        parameters found.

        `progress` gets the number of trials and the lowest cost so far. Raises what `fly` raises.
        """
        study, ranges = self._study, self.file.ranges
        within = {k: v for k, v in self._defaults.items() if ranges[k][0] <= v <= ranges[k][1]}
        study.enqueue_trial(within)  # the first trial has the present values
        for number in range(1, self.file.trials + 1):
            trial, values = ask(study, ranges)
            costs = self._costs(fly, self._training, tuple(values.items()))
            study.tell(trial, sum(costs) / len(costs))
            progress(number, study.best_value)
        best = tuple((key, plain(study.best_params[key], DIGITS)) for key in ranges)
        before = self._costs(fly, self._validation, ())
        return judge(before, self._costs(fly, self._validation, best), best)

    def _costs(self, fly: Fly, cases: Sequence[Case], values: Values) -> list[float]:
        records = fly([replace(case, values=values) for case in cases])
        metrics = (record.figures if record.completed else {} for record in records)
        return [each.get(self.file.objective, self.file.failure) for each in metrics]


def planned(file: TuneFile) -> tuple[list[Case], list[Case], dict[str, float]]:
    """Return the training flights, the validation flights and the present values of the parameters.
    Raises DocumentError."""
    training, validation = _cases(file, file.training), _cases(file, file.validation)
    if shared := len(set(training) & set(validation)):
        raise DocumentError(
            f"{shared} flights are in training and in validation; give other scenarios, "
            "references or seeds"
        )
    return training, validation, _defaults(training[0], file)


def _cases(file: TuneFile, flights: Flights) -> list[Case]:
    campaign = CampaignFile(
        config=file.config,
        controllers=(file.controller,) if file.controller else None,
        references=flights.references,
        scenarios=flights.scenarios,
        firmwares=(file.firmware,),
        seeds=flights.seeds,
    )
    return expand(campaign)


def _defaults(case: Case, file: TuneFile) -> dict[str, float]:
    """Return the present values of the parameters. Raises DocumentError if one is not a
    real number."""
    resolved = case.load().model_dump(mode="json")
    found: dict[str, float] = {}
    for key in file.ranges:
        value: Any = resolved
        for part in key.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        if not isinstance(value, float):
            raise DocumentError(f"ranges.{key} is no real number of the configuration")
        found[key] = value
    return found


def profile(file: TuneFile, tuned: Tuned) -> str:
    """Return the configuration with the tuned values as YAML for `fly --config`."""
    raw = read(read_text(locate(file.config, "configuration")), file.config)
    if file.controller:
        raw["controller"] = file.controller
    for part, (key, _) in itertools.product(PARTS, tuned.values):
        if key.startswith(f"{part}.") and isinstance(raw.get(part), str):
            raw[part] = read_part(part, raw[part])
    for key, value in tuned.values:
        raw = override(raw, f"{key}={value}")
    heading = f"# Tuned for {file.objective}: {tuned}\n"
    return heading + yaml.safe_dump(raw, sort_keys=False)
