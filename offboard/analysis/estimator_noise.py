"""Noise of the vehicle's own estimator: white noise from sample to sample, and the part of the
reported velocity that is not the derivative of the reported position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.identification.trace import NORTH, POSITION, STAMP, VELOCITY, Trace

Array = NDArray[np.float64]

MEAN_OVER_S = 0.5  # time over which reported velocity and position are compared


@dataclass(frozen=True, slots=True)
class EstimatorNoise:
    """Standard deviations; NaN where the trace is too short. The first three are white noise of
    position (m), reported velocity (m/s) and thrust direction (rad); the last one is reported
    velocity less the derivative of reported position (m/s), as means over MEAN_OVER_S."""

    position_m: float
    velocity_mps: float
    attitude_rad: float
    velocity_contradiction_mps: float


def estimator_noise(trace: Trace) -> EstimatorNoise:
    """Noise of the attitudes, positions and velocities in a stretch of flight."""
    stamps, velocity = trace.position[:, STAMP], trace.position[:, VELOCITY]
    direction = trace.attitude[:, NORTH : NORTH + 2]
    return EstimatorNoise(
        position_m=_white_sd(stamps, trace.position[:, POSITION]),
        velocity_mps=_white_sd(stamps, velocity),
        attitude_rad=_white_sd(trace.attitude[:, STAMP], direction),
        velocity_contradiction_mps=_velocity_contradiction(trace),
    )


def _white_sd(stamps: Array, signals: Array) -> float:
    """Sd of white noise in `signals` (N, axes): each sample less the cubic through its two
    neighbours on either side, which follows any motion; by the median, so that jumps do not
    count."""
    if len(signals) < 10:
        return math.nan
    away = np.stack([stamps[i : len(stamps) - 4 + i] - stamps[2:-2] for i in (0, 1, 3, 4)])
    weights = np.ones_like(away)
    for i in range(4):
        for j in range(4):
            if i != j:
                weights[i] *= away[j] / (away[j] - away[i])
    around = np.stack([signals[i : len(signals) - 4 + i] for i in (0, 1, 3, 4)])
    residual = signals[2:-2] - np.einsum("kn,kna->na", weights, around)
    white = residual / np.sqrt(1.0 + np.sum(weights**2, axis=0))[:, None]
    return float(np.median(np.abs(white))) / 0.6745  # of a normal distribution


def _velocity_contradiction(trace: Trace) -> float:
    stamps = trace.position[:, STAMP]
    starts = np.arange(stamps[0], stamps[-1] - MEAN_OVER_S, MEAN_OVER_S)
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
            np.interp(starts + MEAN_OVER_S, stamps, gap) - np.interp(starts, stamps, gap)
        )
    return float(np.std(differences) / MEAN_OVER_S)
