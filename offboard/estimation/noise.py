"""Noise of telemetry (R) and drift of the disturbance (Q), estimated from innovations.

With the right R and Q innovations are white (R. Mehra, 1970). Innovations that change sign from one
message to the next show that the measurement is noisier than configured. Innovations correlated
over a fifth of a second show a disturbance that drifts faster than configured (gusts); the
estimators of PX4 and ArduCopter drift too, but their innovations are correlated for less. Both
estimates are slow, bounded, and never below the configured values.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NOISE_TIME_S = 3.0
NOISE_OUTLIER = 25.0  # limit of a single product, in variances
# Innovations are averaged over SPAN_S and correlated with those two spans earlier.
SPAN_S, LONGEST_SPAN_S, DRIFT_TIME_S = 0.1, 0.3, 3.0
CORRELATED = 0.25  # correlation above which the density grows, by e per second for each 1 above
VISIBLE_M = 5e-5  # smaller innovations do not count


@dataclass(frozen=True, slots=True)
class Noise:
    """Q by densities per root second, R by standard deviations. These were flown on PX4 and
    ArduCopter; half or twice the values made no visible difference. Noise of position and velocity
    and drift of the disturbance are estimated in flight too, and never less than these; the drift
    at most `disturbance_limit_mps2`."""

    acceleration_mps: float = 0.2
    disturbance_mps2: float = 0.15
    disturbance_limit_mps2: float = 1.0
    tilt_radps: float = 0.6
    heading_radps: float = 0.6
    bias_mps: float = 0.08
    position_sd_m: float = 0.002
    velocity_sd_mps: float = 0.005
    attitude_sd_rad: float = 0.001


class NoiseEstimate:
    """R of position and velocity, and the drift in Q, from one message after the other.

    `drift_mps2` (2,): drift of the disturbance per root second, lateral and vertical. The vertical
    one is as configured until `permit_vertical_drift`.
    """

    def __init__(self, noise: Noise) -> None:
        self._least = noise.position_sd_m**2, noise.velocity_sd_mps**2
        self._variances = [0.0, 0.0]
        self.drift_mps2 = np.full(2, noise.disturbance_mps2)
        self._least_drift = noise.disturbance_mps2
        self._drift_limit = max(noise.disturbance_mps2, noise.disturbance_limit_mps2)
        self._drift_limits = np.array([self._drift_limit, noise.disturbance_mps2])
        # mean product of span means two spans apart, and their mean square: lateral, vertical
        self._product, self._square = np.zeros(2), np.zeros(2)
        self.interrupt()

    @property
    def variances(self) -> tuple[float, float]:
        """R of position (m^2) and velocity (m^2/s^2)."""
        (position, velocity), (least_position, least_velocity) = self._variances, self._least
        return max(position, least_position), max(velocity, least_velocity)

    def permit_vertical_drift(self) -> None:
        self._drift_limits[1] = self._drift_limit

    def interrupt(self) -> None:
        """After a jump, a gap or a restart: do not correlate the next innovation with the last."""
        self._last_s = self._began_s = -np.inf
        self._residual: Array | None = None  # of the last message: measured less updated
        self._change: Array | None = None  # its innovation less the residual before
        self._total, self._messages = np.zeros(3), 0  # innovations of position since `_began_s`
        self._means: deque[Array] = deque(maxlen=3)  # of the last spans

    def update(self, time_s: float, innovation: Array, residual: Array) -> None:
        """Use one message of `time_s`: measured less predicted, and measured less updated position
        (m) and velocity (m/s), each (6,), NED."""
        if self._residual is None:
            self._began_s = time_s
        else:
            change = innovation - self._residual
            if self._change is not None:
                self._estimate_noise(time_s - self._last_s, change, self._change)
            self._change = change
        self._residual, self._last_s = residual, time_s
        self._total += innovation[:3]
        self._messages += 1
        span_s = time_s - self._began_s
        if span_s < SPAN_S - 1e-6:
            return
        self._means.append(self._total / self._messages)
        self._total, self._messages, self._began_s = np.zeros(3), 0, time_s
        if len(self._means) == 3:
            self._estimate_drift(min(span_s, LONGEST_SPAN_S), self._means[2], self._means[0])

    def _estimate_noise(self, interval_s: float, change: Array, before: Array) -> None:
        """The measured change since the last message less the predicted one is `change`. For white
        noise of variance s^2, successive changes have the covariance -s^2; for a measurement whose
        error drifts, they have none."""
        north, east, down, *velocity = (change * before).tolist()
        products = (north + east + down) / -3.0, sum(velocity) / -3.0
        share = min(interval_s / NOISE_TIME_S, 0.1)
        for kind, (product, variance) in enumerate(zip(products, self.variances, strict=True)):
            limit = NOISE_OUTLIER * variance
            product = min(max(product, -limit), limit)
            self._variances[kind] += share * (product - self._variances[kind])

    def _estimate_drift(self, span_s: float, now: Array, before: Array) -> None:
        """Update the drift densities from the mean innovations of two spans, (3,) each."""
        share = span_s / DRIFT_TIME_S
        self._product += share * (_by_axis(now * before) - self._product)
        self._square += share * (_by_axis(0.5 * (now**2 + before**2)) - self._square)
        correlation = self._product / (self._square + VISIBLE_M**2)
        grown = self.drift_mps2 * np.exp(span_s * (correlation - CORRELATED))
        self.drift_mps2 = np.clip(grown, self._least_drift, self._drift_limits)


def _by_axis(ned: Array) -> Array:
    """Lateral mean and vertical value of a (3,) in NED."""
    return np.array([0.5 * (ned[0] + ned[1]), ned[2]])
