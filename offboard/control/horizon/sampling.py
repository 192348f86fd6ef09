"""MPPI and the cross-entropy method over the same knots and roll-outs as the swarm.

They exist for comparison with the swarm at the same number of roll-outs. Both draw knots from a
normal distribution about a mean that starts at the base plan, and return the mean.
"""

from __future__ import annotations

from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from offboard.control.horizon.search import Evaluator, Found, Plan, Remaining
from offboard.control.swarm.settings import check_evaluations
from offboard.documents.parameters import Parameters

Array = NDArray[np.float64]

LEAST_SD = 1e-3  # of the reach: least standard deviation of the cross-entropy method


class _Sampling(Parameters):
    """`samples` roll-outs in each of `iterations`. `deviation` is the first standard deviation as
    a fraction of the reach of the knots."""

    samples: int = Field(default=40, ge=4, le=10_000)
    iterations: int = Field(default=70, ge=1, le=10_000)
    deviation: float = Field(default=0.3, gt=0, le=2)

    @model_validator(mode="after")
    def _ends(self) -> Self:
        check_evaluations("samples", self.samples, self.iterations)
        return self


class MppiSampling(_Sampling):
    """Model predictive path integral control (Williams et al. 2017).

    The mean moves to the average of all samples weighted by exp(-cost / temperature).
    `temperature` is a fraction of the mean cost above the best; the standard deviation is
    multiplied by `shrink` after each iteration.
    """

    shrink: float = Field(default=0.93, gt=0, le=1)
    temperature: float = Field(default=0.1, gt=0, le=10)

    def update(self, knots: Array, costs: Array, sd: Array, reach: Array) -> tuple[Array, Array]:
        """Mean and standard deviation (M, 3) of the next samples."""
        above = costs - costs.min()
        usable = above[np.isfinite(above)]
        scale = self.temperature * float(usable.mean()) if len(usable) else 0.0
        weights = np.exp(-above / scale) if scale > 0 else (above == 0).astype(np.float64)
        return knots @ (weights / weights.sum()), self.shrink * sd


class CemSampling(_Sampling):
    """The cross-entropy method (Rubinstein 1999).

    Mean and standard deviation are those of the best `elite`, a fraction of the samples.
    """

    elite: float = Field(default=0.2, gt=0, le=1)

    def update(self, knots: Array, costs: Array, sd: Array, reach: Array) -> tuple[Array, Array]:
        """Mean and standard deviation (M, 3) of the next samples."""
        kept = max(2, round(self.elite * self.samples))
        elite = knots[:, :, np.argsort(costs, kind="stable")[:kept]]
        return elite.mean(axis=2), np.maximum(elite.std(axis=2), LEAST_SD * reach)


def sample(
    evaluate: Evaluator,
    base: Plan,
    reach: Array,
    settings: MppiSampling | CemSampling,
    generator: np.random.Generator,
    remaining_s: Remaining,
) -> Found:
    """The plan at the last mean of the knots within +-reach (M, 3) about `base`."""
    mean, sd = np.zeros_like(reach), settings.deviation * reach
    wide, done = reach[:, :, None], 0
    while done < settings.iterations:
        noise = generator.standard_normal((*reach.shape, settings.samples))
        noise[:, :, 0] = 0.0  # the mean itself is the first sample
        knots = np.clip(mean[:, :, None] + sd[:, :, None] * noise, -wide, wide)
        costs = evaluate.of_knots(base, knots)
        costs = np.where(np.isfinite(costs), costs, np.inf)
        mean, sd = settings.update(knots, costs, sd, reach)
        done += 1
        if remaining_s is not None and remaining_s() <= 0:
            break
    evaluate.of_knots(base, mean[:, :, None])
    plan = evaluate.plan(1, 0)
    return Found(plan, float(np.linalg.norm(sd)), done, done < settings.iterations)
