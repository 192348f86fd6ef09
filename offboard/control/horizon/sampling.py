"""MPPI and the cross-entropy method over the same knots and roll-outs as the swarm: its peers.

Both draw knots from a normal distribution about a mean that starts on the base plan, and answer
with the mean. MPPI weighs all samples by exp(-cost / temperature), the cross-entropy method fits
mean and deviation to the best of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.control.horizon.search import Evaluator, Found, Plan, Remaining
from offboard.control.horizon.settings import SamplingSettings

Array = NDArray[np.float64]

LEAST_SD = 1e-3  # of the reach: what the cross-entropy method never falls below


@dataclass
class _Draws:
    """Samples about a moving mean; the first of them is the mean itself."""

    evaluate: Evaluator
    base: Plan
    reach: Array
    generator: np.random.Generator
    count: int

    def costs(self, mean: Array, sd: Array) -> tuple[Array, Array]:
        """Knots (M, 3, n) within the reach, and their costs (n,), infinite where not finite."""
        noise = self.generator.standard_normal((*self.reach.shape, self.count))
        noise[:, :, 0] = 0.0
        wide = self.reach[:, :, None]
        knots = np.clip(mean[:, :, None] + sd[:, :, None] * noise, -wide, wide)
        costs = self.evaluate.of_knots(self.base, knots)
        return knots, np.where(np.isfinite(costs), costs, np.inf)

    def conclude(self, mean: Array, sd: Array, iterations: int, cut_short: bool) -> Found:
        """The mean as a plan."""
        self.evaluate.of_knots(self.base, mean[:, :, None])
        plan = self.evaluate.picked(1, 0)
        return Found(plan, float(np.linalg.norm(sd)), iterations, cut_short)


def mppi(
    evaluate: Evaluator,
    base: Plan,
    reach: Array,
    settings: SamplingSettings,
    generator: np.random.Generator,
    remaining_s: Remaining,
) -> Found:
    """Model predictive path integral control (Williams et al. 2017) about `base`."""
    draws = _Draws(evaluate, base, reach, generator, settings.samples)
    mean, sd = np.zeros_like(reach), settings.deviation * reach
    done = 0
    while done < settings.iterations:
        knots, costs = draws.costs(mean, sd)
        above = costs - costs.min()
        usable = above[np.isfinite(above)]
        scale = settings.temperature * float(usable.mean()) if len(usable) else 0.0
        weights = np.exp(-above / scale) if scale > 0 else (above == 0).astype(np.float64)
        mean = knots @ (weights / weights.sum())
        sd = settings.shrink * sd
        done += 1
        if remaining_s is not None and remaining_s() <= 0:
            break
    return draws.conclude(mean, sd, done, done < settings.iterations)


def cem(
    evaluate: Evaluator,
    base: Plan,
    reach: Array,
    settings: SamplingSettings,
    generator: np.random.Generator,
    remaining_s: Remaining,
) -> Found:
    """The cross-entropy method (Rubinstein 1999) about `base`."""
    draws = _Draws(evaluate, base, reach, generator, settings.samples)
    mean, sd = np.zeros_like(reach), settings.deviation * reach
    kept = max(2, round(settings.elite * settings.samples))
    done = 0
    while done < settings.iterations:
        knots, costs = draws.costs(mean, sd)
        elite = knots[:, :, np.argsort(costs, kind="stable")[:kept]]
        mean = elite.mean(axis=2)
        sd = np.maximum(elite.std(axis=2), LEAST_SD * reach)
        done += 1
        if remaining_s is not None and remaining_s() <= 0:
            break
    return draws.conclude(mean, sd, done, done < settings.iterations)
