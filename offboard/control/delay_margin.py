"""The delay margin of the tracking loop, and the highest bandwidth with a sufficient margin.

A known delay is compensated by prediction and costs little; the loop becomes unstable where the
delay differs from the one in the vehicle's parameters. The loops of a lateral axis and of the
vertical axis are built as they are flown (a decision every period on the state predicted by
replaying the commands sent; an observer corrected by position and attitude) with another delay of
the plant than the modelled one. A loop is stable if the eigenvalues of its map over one period are
within the unit circle.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from offboard.control.gains import lateral_gain, vertical_gain
from offboard.model.axes import LinearModel, lateral_model, vertical_model
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]

LEAST_MARGIN_S, SHARE_OF_DELAY, SDS = 0.03, 0.25, 3.0  # see `needed_margin`
BANDWIDTH_STEP_RADPS, LEAST_BANDWIDTH_RADPS = 0.25, 1.0
SUBSTEPS = 10
STABLE = 1.0 - 1e-6
# See `observer.Noise`: noise densities of the states and of d'; standard deviations of measurements
# by index of the state
_LATERAL_DENSITIES, _VERTICAL_DENSITIES = (0.0, 0.2, 0.0, 0.6, 0.15), (0.0, 0.2, 0.0, 0.15)
_LATERAL_SDS, _VERTICAL_SDS = {0: 0.002, 2: 0.001}, {0: 0.002}


def needed_margin(vehicle: Vehicle, delay_sd_s: float) -> float:
    """The margin of the tilt's delay that a flight needs, s: 30 ms, a quarter of the delay (jitter
    grows with it), or three standard deviations of the identified delay, whichever is longest."""
    return max(LEAST_MARGIN_S, SHARE_OF_DELAY * vehicle.tilt.delay_s, SDS * delay_sd_s)


def supported_bandwidth(
    vehicle: Vehicle,
    bandwidth_radps: float,
    period_s: float,
    *,
    tilt_margin_s: float,
    thrust_margin_s: float,
) -> float:
    """`bandwidth_radps`, or the highest below it with which the lateral loop bears `tilt_margin_s`
    more than the tilt's delay, and the vertical loop `thrust_margin_s` more or less than the
    thrust's: a modelled delay that is too long makes it unstable, too.

    Found by bisection in steps of BANDWIDTH_STEP_RADPS; never below LEAST_BANDWIDTH_RADPS.
    """

    tilt_s = np.linspace(0.0, tilt_margin_s, 4)
    thrust_s = np.linspace(-thrust_margin_s, thrust_margin_s, 4)

    def stable(bandwidth: float) -> bool:
        lateral = _lateral_loop(vehicle, bandwidth, period_s)
        if not all(map(lateral.stable, tilt_s)):
            return False
        vertical = _vertical_loop(vehicle, bandwidth, period_s)
        return all(map(vertical.stable, thrust_s))

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


def _lateral_loop(vehicle: Vehicle, bandwidth_radps: float, period_s: float) -> _Loop:
    gain = lateral_gain(vehicle, bandwidth_radps, period_s).gain
    model, delay_s = lateral_model(vehicle), vehicle.tilt.delay_s
    return _Loop(model, gain, delay_s, _LATERAL_DENSITIES, _LATERAL_SDS, period_s)


def _vertical_loop(vehicle: Vehicle, bandwidth_radps: float, period_s: float) -> _Loop:
    gain = vertical_gain(vehicle, bandwidth_radps, period_s).gain
    model, delay_s = vertical_model(vehicle), vehicle.thrust_delay_s
    return _Loop(model, gain, delay_s, _VERTICAL_DENSITIES, _VERTICAL_SDS, period_s)


@lru_cache(maxsize=32)  # of the vehicle alone: the same for all bandwidths and delays
def _observer(
    dynamics: bytes,
    input_map: bytes,
    densities: tuple[float, ...],
    sds: tuple[tuple[int, float], ...],
    step_s: float,
) -> tuple[Array, Array, Array]:
    """Transition (n, n), input (n, 1) and correction (n, m) of the observer, per substep."""
    size = len(densities)
    flow = np.frombuffer(dynamics).reshape(size, size)
    step = LinearModel(flow, np.frombuffer(input_map).reshape(size, 1)).sampled(step_s)
    measures = np.eye(size)[[index for index, _ in sds]]
    noise = np.diag(np.square(densities) * step_s)
    noise[0, 0] += 1e-12
    noise[2, 2] += 1e-12
    errors = np.diag(np.square([sd for _, sd in sds]))
    prior = solve_discrete_are(step.dynamics.T, measures.T, noise, errors)
    spread = measures @ prior @ measures.T + errors
    return step.dynamics, step.input_map, prior @ measures.T @ np.linalg.inv(spread)


class _Loop:
    """One axis, SUBSTEPS samples per period: the plant `model`, [p v b b'] or [z v f], and the
    observer, which has a disturbance d of v' beside that."""

    def __init__(
        self,
        model: LinearModel,
        gain: Array,
        delay_s: float,
        densities: tuple[float, ...],
        sds: dict[int, float],
        period_s: float,
    ) -> None:
        self.step_s = period_s / SUBSTEPS
        self._delay_s = delay_s
        self._size = size = len(model.dynamics)
        self._measured = list(sds)
        self._measures = np.eye(size + 1)[self._measured]
        dynamics = np.zeros((size + 1, size + 1))
        dynamics[:size, :size], dynamics[1, size] = model.dynamics, 1.0
        inputs = np.append(model.input_map, 0.0)
        self._flow, self._push, self._correction = _observer(
            dynamics.tobytes(), inputs.tobytes(), densities, tuple(sds.items()), self.step_s
        )
        # The target compensates the disturbance: with v' = -k b + d, b_r = b_ff = d / k
        self._gain = np.append(gain, (1.0 + gain[2]) / model.dynamics[1, 2])[None, :]

    def stable(self, extra_s: float) -> bool:
        """Whether the loop is stable when the plant's delay is `extra_s` longer."""
        return self._radius(extra_s) < STABLE

    def _radius(self, extra_s: float) -> float:
        """Spectral radius of the map over one period."""
        ahead = round(self._delay_s / self.step_s)
        behind = max(round((self._delay_s + extra_s) / self.step_s), 0)
        kept = max(ahead, behind) // SUBSTEPS + 3  # commands of this and earlier periods
        size = self._size
        state = np.eye(2 * size + 1 + kept)
        plant, observer, sent = np.split(state, (size, 2 * size + 1))
        predicted = observer
        for i in range(ahead):
            predicted = self._flow @ predicted + self._push * _in_force(sent, i - ahead)
        sent = np.vstack((-self._gain @ predicted, sent[:-1]))
        for i in range(-SUBSTEPS, 0):
            plant = self._flow[:size, :size] @ plant + self._push[:size] * _in_force(
                sent, i - behind
            )
            observer = self._flow @ observer + self._push * _in_force(sent, i - ahead)
            seen = plant[self._measured] - self._measures @ observer
            observer = observer + self._correction @ seen
        passed = np.vstack((plant, observer, sent))
        return float(np.abs(np.linalg.eigvals(passed)).max())


def _in_force(sent: Array, substep: int) -> Array:
    """The command that acts in `substep` < 0, counted back from the end of the newest period."""
    row: Array = sent[-(substep // SUBSTEPS) - 1]
    return row
