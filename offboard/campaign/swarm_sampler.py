"""Our swarm as a sampler of optuna: trial n is particle n modulo the particles of its generation.

The swarm is rebuilt from the seed and the trials of the study, so that a study goes on in another
process. A trial that was interrupted, or had given values, has infinite cost for its particle.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, FloatDistribution
from optuna.samplers import BaseSampler, RandomSampler
from optuna.trial import FrozenTrial, TrialState

from offboard.campaign.searchers import SEARCHERS

PARTICLES = 8


class SwarmSampler(BaseSampler):
    """Samples the float parameters `ranges` with the swarm of `control.swarm`."""

    def __init__(self, ranges: dict[str, tuple[float, float]], seed: int) -> None:
        self._ranges = ranges
        self._seed = seed
        self._other = RandomSampler(seed)

    def infer_relative_search_space(
        self, study: optuna.Study, trial: FrozenTrial
    ) -> dict[str, BaseDistribution]:
        return {name: FloatDistribution(*ends) for name, ends in self._ranges.items()}

    def sample_relative(
        self, study: optuna.Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        swarm = SEARCHERS["swarm"](len(self._ranges), PARTICLES, self._seed)
        finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        costs = {t.number: t.value for t in finished if "fixed_params" not in t.system_attrs}
        generation, particle = divmod(trial.number, PARTICLES)
        for done in range(generation):
            swarm.ask()
            first = done * PARTICLES
            known = (costs.get(number) for number in range(first, first + PARTICLES))
            swarm.tell([np.inf if cost is None else cost for cost in known])
        point = swarm.ask()[particle]
        return {
            name: low + float(share) * (high - low)
            for (name, (low, high)), share in zip(self._ranges.items(), point, strict=True)
        }

    def sample_independent(
        self,
        study: optuna.Study,
        trial: FrozenTrial,
        param_name: str,
        param_distribution: BaseDistribution,
    ) -> Any:
        return self._other.sample_independent(study, trial, param_name, param_distribution)
