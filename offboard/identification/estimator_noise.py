"""What an estimator reports beside the motion: noise from sample to sample, and a velocity that is
not the derivative of its position. Knows a trace and no vehicle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.identification.trace import NORTH, POSITION, STAMP, VELOCITY, Trace

Array = NDArray[np.float64]

SLOWNESS_S = 0.5  # over which a velocity is judged


@dataclass(frozen=True, slots=True)
class EstimatorNoise:
    """Standard deviations: from sample to sample of position (m), reported velocity (m/s) and
    thrust direction (rad); and the part of the reported velocity that is not the derivative of the
    reported position, as means over half a second."""

    position_m: float
    velocity_mps: float
    attitude_rad: float
    velocity_contradiction_mps: float


def noise_of(trace: Trace) -> EstimatorNoise:
    """Of a stretch of flight; NaN where it is too short."""
    velocity = trace.position[:, VELOCITY]
    return EstimatorNoise(
        position_m=_white_sd(trace.position[:, STAMP], trace.position[:, POSITION]),
        velocity_mps=_white_sd(trace.position[:, STAMP], velocity),
        attitude_rad=_white_sd(trace.attitude[:, STAMP], trace.attitude[:, NORTH : NORTH + 2]),
        velocity_contradiction_mps=_contradiction(trace),
    )


def _white_sd(stamps: Array, signals: Array) -> float:
    """What differs from sample to sample, (N, axes): each against the cubic through its two
    neighbours on either side, which any motion follows; median, so that jumps do not count."""
    if len(signals) < 10:
        return math.nan
    away = np.stack([stamps[i : len(stamps) - 4 + i] - stamps[2:-2] for i in (0, 1, 3, 4)])
    weights = np.ones_like(away)
    for i in range(4):
        for j in range(4):
            if i != j:
                weights[i] *= away[j] / (away[j] - away[i])
    around = np.stack([signals[i : len(signals) - 4 + i] for i in (0, 1, 3, 4)])
    surprise = signals[2:-2] - np.einsum("kn,kna->na", weights, around)
    white = surprise / np.sqrt(1.0 + np.sum(weights**2, axis=0))[:, None]
    return float(np.median(np.abs(white))) / 0.6745  # of a normal distribution


def _contradiction(trace: Trace) -> float:
    """Mean reported velocity less the mean velocity of the reported position, over SLOWNESS_S."""
    stamps = trace.position[:, STAMP]
    starts = np.arange(stamps[0], stamps[-1] - SLOWNESS_S, SLOWNESS_S)
    if len(starts) < 2:
        return math.nan
    differences = []
    for axis in range(3):
        position, velocity = trace.position[:, 1 + axis], trace.position[:, 4 + axis]
        travelled = np.concatenate(
            ([0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * np.diff(stamps)))
        )
        gap = travelled - position
        differences.append(
            np.interp(starts + SLOWNESS_S, stamps, gap) - np.interp(starts, stamps, gap)
        )
    return float(np.std(differences) / SLOWNESS_S)
