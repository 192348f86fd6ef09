"""Tuning: parameters that lower a figure on training flights, judged on validation flights.

    ranges:
      controller.bandwidth_radps: [3, 9]
    training: {scenarios: [px4_like, gusts], seeds: 3}
    validation: {scenarios: [all_together, wind_2mps], seeds: 10}

The study (optuna, journal file) and the results of all flights lie in a folder, so that an
interrupted tuning goes on.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import AfterValidator, Field

from offboard.campaign.campaign import check
from offboard.campaign.cases import SCENARIO, Case, Values, expand, rounded
from offboard.campaign.code import code_hash
from offboard.campaign.document import CampaignFile, Name, Names, Ranges, Seed
from offboard.campaign.evaluate import Evaluator
from offboard.campaign.results import Record
from offboard.campaign.table import FIGURE_COLUMNS
from offboard.campaign.verdict import Verdict, judge
from offboard.documents.errors import DocumentError, UserError, naming
from offboard.documents.extras import install
from offboard.documents.parameters import Parameters
from offboard.documents.reading import override, parse, read
from offboard.documents.shipped import locate, read_text
from offboard.run.configuration import FOLDERS, read_part

FOLDER = "tunings"


def _figure(name: str) -> str:
    if name not in FIGURE_COLUMNS:
        known = ", ".join(FIGURE_COLUMNS)
        raise ValueError(f"{name!r} is no figure of a lockstep flight; there are {known}")
    return name


class Flights(Parameters):
    """A set of flights: every reference in every scenario with every seed."""

    references: Names | None = None
    scenarios: Annotated[tuple[Name | dict[str, Any], ...], Field(min_length=1)]
    seeds: (
        Annotated[int, Field(ge=1, le=1000)] | Annotated[tuple[Seed, ...], Field(min_length=1)]
    ) = 3


class TuneFile(Parameters):
    """A tuning. `objective` is the figure that is minimised, averaged over the flights; a flight
    that is not completed costs `failure`."""

    config: Name = "flight"
    controller: Name | None = None
    firmware: Name = "px4"
    ranges: Ranges
    training: Flights
    validation: Flights
    objective: Annotated[str, AfterValidator(_figure)] = "rmse_position_m"
    failure: float = Field(default=5.0, gt=0, le=1e6)
    sampler: Literal["tpe", "cma", "swarm"] = "tpe"
    trials: int = Field(default=60, ge=2, le=100_000)
    seed: Seed = 1


@dataclass(frozen=True, slots=True)
class Tuned:
    """The best parameters found, and the verdict on the validation flights."""

    values: Values
    verdict: Verdict


def read_tune(name: str) -> tuple[TuneFile, str]:
    """A shipped tuning or a file, and its path for errors. Raises DocumentError."""
    path = locate(name, FOLDER, "tuning") if "." not in name else Path(name)
    file = parse(read_text(path), TuneFile, str(path), "tuning")
    for key in file.ranges:
        if key.startswith((SCENARIO, "vehicle.")):
            raise DocumentError(f"{path}: ranges.{key}: no scenario and no vehicle is tuned")
    return file, str(path)


class Tuning:
    """Finds and judges parameters. Raises DocumentError for what cannot be flown, and UserError
    without optuna."""

    def __init__(self, file: TuneFile, source: str) -> None:
        if find_spec("optuna") is None:
            raise UserError(f"tuning needs optuna: {install('tune')}")
        self.file = file
        with naming(source):
            self._training = _cases(file, file.training)
            self._validation = _cases(file, file.validation)
            shared = len(set(self._training) & set(self._validation))
            if shared:
                raise DocumentError(
                    f"{shared} flights are in training and in validation; give other scenarios, "
                    "references or seeds"
                )
            self._defaults = _defaults(self._training[0], file)
            check([self._training[0].with_values(tuple(self._defaults.items()))])

    def run(
        self, folder: Path, evaluator: Evaluator, progress: Callable[[int, float], None]
    ) -> Tuned:
        """Search, then fly the validation set with and without what was found.

        `progress` gets the number of trials and the lowest cost so far. Raises what `Evaluator.fly`
        raises.
        """
        study = _study(folder, self.file, self._training)
        if not any(trial.state.is_finished() for trial in study.trials):
            study.enqueue_trial({k: v for k, v in self._defaults.items() if self._within(k, v)})
        while (count := sum(trial.state.is_finished() for trial in study.trials)) < (
            self.file.trials
        ):
            trial = study.ask()
            values = tuple(
                (key, rounded(trial.suggest_float(key, *ends)))
                for key, ends in self.file.ranges.items()
            )
            costs = self._costs(evaluator, self._training, values)
            study.tell(trial, sum(costs) / len(costs))
            progress(count + 1, study.best_value)
        best = tuple((key, rounded(study.best_params[key])) for key in self.file.ranges)
        before = self._costs(evaluator, self._validation, ())
        return Tuned(best, judge(before, self._costs(evaluator, self._validation, best)))

    def _within(self, key: str, value: float) -> bool:
        low, high = self.file.ranges[key]
        return low <= value <= high

    def _costs(self, evaluator: Evaluator, cases: Sequence[Case], values: Values) -> list[float]:
        records = evaluator.fly([case.with_values(values) if values else case for case in cases])
        return [self._cost(record) for record in records]

    def _cost(self, record: Record) -> float:
        if not record.completed:
            return self.file.failure
        return record.figures.get(self.file.objective, self.file.failure)


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
    """The present values of the parameters. Raises DocumentError for one that is no number."""
    resolved = case.request(Path()).resolve().model_dump(mode="json")
    found: dict[str, float] = {}
    for key in file.ranges:
        value: Any = resolved
        for part in key.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        if not isinstance(value, float | int) or isinstance(value, bool):
            raise DocumentError(f"ranges.{key} is no number of the configuration")
        found[key] = float(value)
    return found


def _study(folder: Path, file: TuneFile, training: Sequence[Case]) -> Any:
    """The study in a folder, begun or continued. Its name is the hash of all that decides a cost,
    so that no trial of another tuning or of other code counts."""
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    from offboard.campaign.swarm_sampler import SwarmSampler

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    samplers: dict[str, Callable[[], Any]] = {
        "tpe": lambda: optuna.samplers.TPESampler(seed=file.seed),
        "cma": lambda: optuna.samplers.CmaEsSampler(seed=file.seed),
        "swarm": lambda: SwarmSampler(file.ranges, file.seed),
    }
    decides = file.model_dump(mode="json", include={"ranges", "objective", "failure", "sampler"})
    decided = [code_hash(), file.seed, decides, [case.key for case in training]]
    name = hashlib.sha256(json.dumps(decided).encode()).hexdigest()[:16]
    storage = JournalStorage(JournalFileBackend(str(folder / "tune.journal")))
    return optuna.create_study(
        storage=storage, study_name=name, sampler=samplers[file.sampler](), load_if_exists=True
    )


def profile(file: TuneFile, tuned: Tuned) -> str:
    """The configuration with the tuned values, as `fly --config` takes it."""
    raw = read(read_text(locate(file.config, "", "configuration")), file.config)
    if file.controller:
        raw["controller"] = file.controller
    for part, (key, _) in itertools.product(FOLDERS, tuned.values):
        if key.startswith(f"{part}.") and isinstance(raw.get(part), str):
            raw[part] = read_part(part, raw[part])
    for key, value in tuned.values:
        raw = override(raw, f"{key}={value}")
    heading = f"# Tuned for {file.objective}: {tuned.verdict}\n"
    return heading + yaml.safe_dump(raw, sort_keys=False)
