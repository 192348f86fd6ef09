"""The highest bandwidth at which the loop is stable for every delay that the vehicle may have.

A known delay is compensated by prediction and costs little; the loop becomes unstable if the real
delay differs too much from the one used for the prediction. The closed loops of a lateral axis and
of the vertical one are built with such a difference: a decision every period, from the state
predicted by replaying the commands sent, and an observer updated by position and attitude. A loop
is stable if the eigenvalues of its transition matrix over one period are within the unit circle.

An attitude loop with limited angular acceleration or rate follows large commands more slowly. The
lateral bandwidth is therefore limited so that the largest feedback stays within these limits.

The delay margin from the phase margin of the loop's frequency response
(`control.stability_margins`) agrees with this to 10 % for delays below 60 ms. At 10 Hz and 90 to
310 ms, where the loop gain crosses 1 several times, it is up to 60 % too long, so it is not used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from offboard.control.base import Bandwidth
from offboard.control.gains import lateral_gain, vertical_gain
from offboard.estimation.noise import Noise
from offboard.model.axes import LinearModel, lateral_model, vertical_model
from offboard.model.vehicle import DelayUncertainty, Vehicle

Array = NDArray[np.float64]

NOISE = Noise()
LEAST_MARGIN_S, SHARE_OF_DELAY = 0.04, 0.15  # for jitter, which grows with the delay
STEP_RADPS, LEAST_RADPS = 0.25, 1.0
SUBSTEPS = 10  # per period; the observer is corrected at each
STABLE = 1.0 - 1e-6  # limit of the largest eigenvalue
FEEDBACK_LIMIT = 0.3  # the default of `feedback_limit`
# Observer: noise densities of [p v b b' d] and [z v f d]; (index, sd) of each measurement
_Q = NOISE.acceleration_mps, 1e-5, NOISE.tilt_radps, NOISE.disturbance_mps2
LATERAL_DENSITIES, VERTICAL_DENSITIES = (1e-5, *_Q), (1e-5, *_Q[:2], _Q[3])
LATERAL_SDS = (0, NOISE.position_sd_m), (2, NOISE.attitude_sd_rad)
VERTICAL_SDS = ((0, NOISE.position_sd_m),)


def supported_bandwidth(
    vehicle: Vehicle, uncertainty: DelayUncertainty, period_s: float, most_radps: float
) -> Bandwidth:
    """Return the highest bandwidth, at most `most_radps`, at which each loop stays stable: the
    lateral loop if the delay of the tilt is longer than modelled, the vertical one if the delay of
    the thrust is longer or shorter (a modelled delay that is too long makes it unstable, too).

    The delays differ by up to `uncertainty`, at least 40 ms, that of the tilt also at least 15 % of
    itself. The lateral bandwidth is at most `tilting_bandwidth`. Below `most_radps` the search has
    steps of STEP_RADPS; it never goes below LEAST_RADPS.
    """
    vehicle = vehicle.later_by(uncertainty.link_s)
    tilt_s = max(LEAST_MARGIN_S, SHARE_OF_DELAY * vehicle.tilt.delay_s, uncertainty.tilt_s)
    thrust_s = max(LEAST_MARGIN_S, uncertainty.thrust_s)

    def lateral_bears(bandwidth_radps: float) -> bool:
        loop = _Loop(
            lateral_model(vehicle), lateral_gain(vehicle, bandwidth_radps, period_s).gain,
            LATERAL_DENSITIES, LATERAL_SDS, vehicle.tilt.delay_s, period_s,
        )  # fmt: skip
        return all(map(loop.is_stable, np.linspace(0.0, tilt_s, 4)))

    def vertical_bears(bandwidth_radps: float) -> bool:
        loop = _Loop(
            vertical_model(vehicle), vertical_gain(vehicle, bandwidth_radps, period_s).gain,
            VERTICAL_DENSITIES, VERTICAL_SDS, vehicle.thrust_delay_s, period_s,
        )  # fmt: skip
        return all(map(loop.is_stable, np.linspace(-thrust_s, thrust_s, 4)))

    lateral_radps = _highest(lateral_bears, min(most_radps, tilting_bandwidth(vehicle)[0]))
    return Bandwidth(lateral_radps, _highest(vertical_bears, most_radps))


def tilting_bandwidth(vehicle: Vehicle) -> tuple[float, str]:
    """Return the lateral bandwidth, rad/s, at which feedback of FEEDBACK_LIMIT reaches the limit of
    the tilt's angular acceleration or rate, whichever comes first, and a sentence that names this
    limit. Limits are from the vehicle file or the autopilot's parameters."""
    most_radps2 = min(vehicle.angular_acceleration_limit_radps2[:2])
    most_radps = min(vehicle.angular_rate_limit_radps[:2])
    acceleration = f"the autopilot limits the angular acceleration of the tilt to {most_radps2:.1f}"
    rate = f"the autopilot limits the angular rate of the tilt to {most_radps:.1f}"
    lowest, why = min(
        (math.sqrt(most_radps2 / FEEDBACK_LIMIT), f"{acceleration} rad/s^2"),
        (most_radps / FEEDBACK_LIMIT, f"{rate} rad/s"),
    )
    return max(LEAST_RADPS, lowest), why


def _highest(bears: Callable[[float], bool], most_radps: float) -> float:
    """Return the highest bandwidth at which the loop is stable: for which `bears` is true."""
    if most_radps <= LEAST_RADPS or bears(most_radps):
        return most_radps
    low, high = 0, math.ceil((most_radps - LEAST_RADPS) / STEP_RADPS)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if bears(LEAST_RADPS + middle * STEP_RADPS) else (low, middle)
    return LEAST_RADPS + low * STEP_RADPS


class _Loop:
    """Closed loop of one axis, sampled SUBSTEPS times per period: the plant `model`, [p v b b'] or
    [z v f], and the observer, whose state also has a disturbance d of v'."""

    def __init__(
        self,
        model: LinearModel,
        gain: Array,
        densities: tuple[float, ...],
        sds: tuple[tuple[int, float], ...],
        delay_s: float,
        period_s: float,
    ) -> None:
        self._step_s, self._delay_s = period_s / SUBSTEPS, delay_s
        self._size = size = len(model.dynamics)
        dynamics = np.zeros((size + 1, size + 1))
        dynamics[:size, :size], dynamics[1, size] = model.dynamics, 1.0
        inputs = np.append(model.input_map, 0.0)
        self._step, self._correction = _observer(
            dynamics.tobytes(), inputs.tobytes(), densities, sds, self._step_s
        )
        self._measured = [index for index, _ in sds]
        # The target compensates the disturbance: with v' = -k b + d, b_r = b_ff = d / k
        self._gain = np.append(gain, (1.0 + gain[2]) / model.dynamics[1, 2])[None, :]

    def is_stable(self, extra_s: float) -> bool:
        """Whether the loop is stable when the plant's delay is `extra_s` longer."""
        ahead = round(self._delay_s / self._step_s)
        behind = max(round((self._delay_s + extra_s) / self._step_s), 0)
        kept = max(ahead, behind) // SUBSTEPS + 3  # commands of this and earlier periods
        size, flow, push = self._size, self._step.dynamics, self._step.input_map
        plant, observer, sent = np.split(np.eye(2 * size + 1 + kept), (size, 2 * size + 1))
        predicted = observer
        for i in range(ahead):
            predicted = flow @ predicted + push * _in_force(sent, i - ahead)
        sent = np.vstack((-self._gain @ predicted, sent[:-1]))
        for i in range(-SUBSTEPS, 0):
            plant = flow[:size, :size] @ plant + push[:size] * _in_force(sent, i - behind)
            observer = flow @ observer + push * _in_force(sent, i - ahead)
            seen = plant[self._measured] - observer[self._measured]
            observer = observer + self._correction @ seen
        passed = np.vstack((plant, observer, sent))
        return float(np.abs(np.linalg.eigvals(passed)).max()) < STABLE


def _in_force(sent: Array, substep: int) -> Array:
    """Return the command that acts in `substep` < 0, counted from the end of the newest period."""
    row: Array = sent[-(substep // SUBSTEPS) - 1]
    return row


@lru_cache(maxsize=32)  # depends on the vehicle only, not on bandwidth or delays
def _observer(
    dynamics: bytes,
    input_map: bytes,
    densities: tuple[float, ...],
    sds: tuple[tuple[int, float], ...],
    step_s: float,
) -> tuple[LinearModel, Array]:
    """Return the model of the observer, sampled per substep, and its gain (n, m)."""
    import control  # takes a second: imported only to design an observer

    size = len(densities)
    flow = np.frombuffer(dynamics).reshape(size, size)
    step = LinearModel(flow, np.frombuffer(input_map).reshape(size, 1)).sampled(step_s)
    measures = np.eye(size)[[index for index, _ in sds]]
    noise = step_s * np.diag(np.square(densities))
    errors = np.diag(np.square([sd for _, sd in sds]))
    predicting, _, _ = control.dlqe(step.dynamics, np.eye(size), measures, noise, errors)
    return step, np.linalg.solve(step.dynamics, predicting)
