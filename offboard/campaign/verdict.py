"""Whether a candidate is better than what it replaces: paired flights, with confidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

CONFIDENCE = 0.95
RESAMPLES = 9999
SEED = 1


@dataclass(frozen=True, slots=True)
class Verdict:
    """Costs of the same flights with both: means, and the difference, candidate less base.

    `low` and `high` are the bootstrap interval (percentile, 95 %) of the mean difference,
    `p_value` that of Wilcoxon's signed-rank test, one-sided.
    """

    flights: int
    base: float
    candidate: float
    low: float
    high: float
    p_value: float

    @property
    def better(self) -> bool:
        """Both the interval and the test say so."""
        return self.high < 0.0 and self.p_value < 1.0 - CONFIDENCE

    def __str__(self) -> str:
        return (
            f"mean cost {self.base:.4g} before, {self.candidate:.4g} after, difference "
            f"{self.low:.2g} .. {self.high:.2g} (95 %), p = {self.p_value:.2g}, "
            f"{self.flights} flights each"
        )


def judge(base: Sequence[float], candidate: Sequence[float]) -> Verdict:
    """Compare costs of paired flights (same scenario, same seed)."""
    before, after = np.asarray(base, float), np.asarray(candidate, float)
    difference = after - before
    low = high = float(difference.mean())
    if len(difference) > 1:
        interval = stats.bootstrap(
            (difference,), np.mean, confidence_level=CONFIDENCE, n_resamples=RESAMPLES,
            method="percentile", random_state=np.random.default_rng(SEED),
        ).confidence_interval  # fmt: skip
        low, high = float(interval.low), float(interval.high)
    p_value = 1.0
    if np.any(difference != 0.0):
        p_value = float(stats.wilcoxon(after, before, alternative="less").pvalue)
    return Verdict(len(before), float(before.mean()), float(after.mean()), low, high, p_value)
