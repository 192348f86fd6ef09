"""The delay margin of the tracking loop, and the highest bandwidth with a sufficient margin.

A known delay is compensated by prediction and costs little; the loop becomes unstable where the
delay differs from the one in the vehicle's parameters. The loop of one lateral axis is built as it
is flown (a decision every period on the state predicted by replaying the commands sent; an observer
corrected by position and attitude) with the plant's delay longer than the modelled one. It is
stable if the eigenvalues of its map over one period are within the unit circle.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from offboard.control.riccati import lateral_cost_to_go
from offboard.model.axes import LinearModel, lateral_model
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]

LEAST_MARGIN_S, SHARE_OF_DELAY, SDS = 0.03, 0.25, 3.0  # see `needed_margin`
BANDWIDTH_STEP_RADPS, LEAST_BANDWIDTH_RADPS = 0.25, 1.0
SUBSTEPS = 10
LONGEST_S = 0.6
STABLE = 1.0 - 1e-6
# See ObserverSettings: noise densities of v', b'', d', standard deviations of position, attitude
_DENSITIES = np.array([0.0, 0.2, 0.0, 0.6, 0.15])
_SDS = np.array([0.002, 0.001])


def delay_margin(vehicle: Vehicle, bandwidth_radps: float, period_s: float) -> float:
    """The least delay beyond the modelled one with which the loop is unstable, s; at most
    LONGEST_S."""
    loop = _Loop(vehicle, bandwidth_radps, period_s)
    extra_s = 0.0
    while extra_s < LONGEST_S and loop.radius(extra_s) < STABLE:
        extra_s += loop.step_s
    return extra_s


def needed_margin(vehicle: Vehicle, delay_sd_s: float) -> float:
    """The delay margin that a flight needs, s: 30 ms, a quarter of the delay (jitter grows with
    it), or three standard deviations of the identified delay, whichever is longest."""
    return max(LEAST_MARGIN_S, SHARE_OF_DELAY * vehicle.tilt.delay_s, SDS * delay_sd_s)


def supported_bandwidth(
    vehicle: Vehicle, bandwidth_radps: float, period_s: float, needed_s: float
) -> float:
    """`bandwidth_radps`, or the highest below it whose delay margin is `needed_s`.

    Found by bisection in steps of BANDWIDTH_STEP_RADPS; never below LEAST_BANDWIDTH_RADPS.
    """
    fractions = np.linspace(0.0, needed_s, 4)

    def stable(bandwidth: float) -> bool:
        loop = _Loop(vehicle, bandwidth, period_s)
        return all(loop.radius(float(extra_s)) < STABLE for extra_s in fractions)

    if bandwidth_radps <= LEAST_BANDWIDTH_RADPS or stable(bandwidth_radps):
        return bandwidth_radps
    steps = math.ceil((bandwidth_radps - LEAST_BANDWIDTH_RADPS) / BANDWIDTH_STEP_RADPS)
    low, high = 0, steps  # LEAST_BANDWIDTH_RADPS counts as stable
    while high - low > 1:
        middle = (low + high) // 2
        if stable(LEAST_BANDWIDTH_RADPS + middle * BANDWIDTH_STEP_RADPS):
            low = middle
        else:
            high = middle
    return LEAST_BANDWIDTH_RADPS + low * BANDWIDTH_STEP_RADPS


class _Loop:
    """One lateral axis, SUBSTEPS samples per period: plant [p v b b'], observer [p v b b' d]."""

    def __init__(self, vehicle: Vehicle, bandwidth_radps: float, period_s: float) -> None:
        model = lateral_model(vehicle)
        self.step_s = period_s / SUBSTEPS
        self._delay_s = vehicle.tilt.delay_s
        dynamics = np.zeros((5, 5))
        dynamics[:4, :4], dynamics[1, 4] = model.dynamics, 1.0
        step = LinearModel(dynamics, np.vstack((model.input_map, [0.0]))).sampled(self.step_s)
        self._flow, self._push = step.dynamics, step.input_map
        measures = np.zeros((2, 5))
        measures[0, 0] = measures[1, 2] = 1.0
        noise = np.diag(_DENSITIES**2 * self.step_s)
        noise[0, 0] += 1e-12
        noise[2, 2] += 1e-12
        sds = np.diag(_SDS**2)
        prior = solve_discrete_are(self._flow.T, measures.T, noise, sds)
        self._correction = prior @ measures.T @ np.linalg.inv(measures @ prior @ measures.T + sds)
        self._measures = measures
        gain = lateral_cost_to_go(vehicle, bandwidth_radps, period_s).gain
        # The target compensates the disturbance: b_r = b_ff = d / g
        self._gain = np.append(gain, -(1.0 + gain[2]) / vehicle.gravity_mps2)[None, :]

    def radius(self, extra_s: float) -> float:
        """Spectral radius of the map over one period, the plant's delay being `extra_s` longer."""
        ahead = round(self._delay_s / self.step_s)
        behind = round((self._delay_s + extra_s) / self.step_s)
        kept = max(ahead, behind) // SUBSTEPS + 3  # commands of this and earlier periods
        state = np.eye(9 + kept)
        plant, observer, sent = state[:4], state[4:9], state[9:]
        predicted = observer
        for i in range(ahead):
            predicted = self._flow @ predicted + self._push * _in_force(sent, i - ahead)
        sent = np.vstack((-self._gain @ predicted, sent[:-1]))
        for i in range(-SUBSTEPS, 0):
            plant = self._flow[:4, :4] @ plant + self._push[:4] * _in_force(sent, i - behind)
            observer = self._flow @ observer + self._push * _in_force(sent, i - ahead)
            seen = plant[[0, 2]] - self._measures @ observer
            observer = observer + self._correction @ seen
        passed = np.vstack((plant, observer, sent))
        return float(np.abs(np.linalg.eigvals(passed)).max())


def _in_force(sent: Array, substep: int) -> Array:
    """The command that acts in `substep` < 0, counted back from the end of the newest period."""
    row: Array = sent[-(substep // SUBSTEPS) - 1]
    return row
