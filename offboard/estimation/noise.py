"""Noise of telemetry (R) and drift of the disturbance (Q), estimated in flight.

White noise is measured by differences of successive measurements in which motion cancels, so that
it does not depend on the filter. Innovations that are correlated over a fifth of a second (R.
Mehra, 1970) show that the disturbance drifts faster than configured (gusts). The estimators of PX4
and ArduCopter drift too, but the innovations from that are correlated for a shorter time. Without
noise, innovations from ArduCopter's EKF3 repeat with its GPS at 5 Hz, so that the estimated drift
grows in calm air too, where a large value does no harm. Both estimates change slowly, are bounded,
and are never below the configured values.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NOISE_TIME_S = 3.0  # time constant of the noise estimate
NOISE_OUTLIER = 25.0  # upper limit of a single squared difference, in variances
START_SDS = 0.002, 0.005  # of position (m) and velocity (m/s)
# Innovations are averaged over SPAN_S and correlated with the average two spans earlier, with the
# time constant DRIFT_TIME_S
SPAN_S, LONGEST_SPAN_S, DRIFT_TIME_S = 0.1, 0.3, 3.0
CORRELATED = 0.25  # the logarithm of the drift grows by correlation minus this per second
VISIBLE_M = 1e-5  # smaller innovations do not count
# A drift of 0.5 to 1.0 after each change of the model was tried. Without noise the error of a
# flight was half as large. With 30 % loss the disturbance followed lost setpoints, and the largest
# error of 50 flights was twice as large.


@dataclass(frozen=True, slots=True)
class Noise:
    """Q as noise densities per root second, R as standard deviations. Half or twice these values
    made no visible difference on PX4 and ArduCopter, except for the position, which both report
    with 2e-5 m of white noise: with 2 mm, predictions from logs of a real PX4 are 6 to 10 % worse;
    with 0.1 mm, commands chatter. Noise of position and velocity and drift of the disturbance are
    also estimated in flight. Estimates are at least the values here, the drift at most
    `disturbance_limit_mps2`."""

    acceleration_mps: float = 0.2
    disturbance_mps2: float = 0.15
    disturbance_limit_mps2: float = 1.0
    tilt_radps: float = 0.6
    heading_radps: float = 0.6
    bias_mps: float = 0.08
    position_sd_m: float = 0.0005
    velocity_sd_mps: float = 0.005
    attitude_sd_rad: float = 0.001


class NoiseEstimate:
    """Estimate of R of position and velocity and of the drift in Q, updated with each message.

    `drift_mps2` (2,) is the drift of the disturbance per root second, lateral and vertical. The
    vertical one keeps its configured value until `permit_vertical_drift`.
    """

    def __init__(self, noise: Noise) -> None:
        self._least = noise.position_sd_m**2, noise.velocity_sd_mps**2
        self._variances = np.square(START_SDS)
        self.drift_mps2 = np.full(2, noise.disturbance_mps2)
        self._least_drift = noise.disturbance_mps2
        self._drift_limit = max(noise.disturbance_mps2, noise.disturbance_limit_mps2)
        self._drift_limits = np.array([self._drift_limit, noise.disturbance_mps2])
        # averages of the product of span means two spans apart, and of their squares: lateral,
        # vertical
        self._product, self._square = np.zeros(2), np.zeros(2)
        self.interrupt()

    @property
    def variances(self) -> tuple[float, float]:
        """R of position (m^2) and velocity (m^2/s^2)."""
        position, velocity = self._variances.tolist()
        return max(position, self._least[0]), max(velocity, self._least[1])

    def permit_vertical_drift(self) -> None:
        self._drift_limits[1] = self._drift_limit

    def interrupt(self) -> None:
        """Do not compare the next message with the last one: after a jump, gap or restart."""
        self._last_s = self._began_s = -np.inf
        self._measured: Array | None = None  # in the last message
        self._rates: tuple[Array, float] | None = None  # see `_estimate_noise`
        self._total, self._messages = np.zeros(3), 0  # innovations of position since `_began_s`
        self._means: deque[Array] = deque(maxlen=3)  # mean innovations of the last spans

    def update(self, time_s: float, innovation: Array, measured: Array) -> None:
        """Use a message of `time_s`. `measured` (6,) is position (m) and velocity (m/s), NED,
        `innovation` (6,) is `measured` minus the prediction."""
        if self._measured is None:
            self._began_s = time_s
        elif time_s > self._last_s:  # if not, a newer attitude has arrived before both
            self._estimate_noise(time_s - self._last_s, measured, self._measured)
        self._measured, self._last_s = measured, time_s
        self._total += innovation[:3]
        self._messages += 1
        span_s = time_s - self._began_s
        if span_s < SPAN_S - 1e-6:
            return
        self._means.append(self._total / self._messages)
        self._total, self._messages, self._began_s = np.zeros(3), 0, time_s
        if len(self._means) == 3:
            self._estimate_drift(min(span_s, LONGEST_SPAN_S), self._means[2], self._means[0])

    def _estimate_noise(self, interval_s: float, now: Array, before: Array) -> None:
        """Update the noise variances. Rates of change from one message to the next (those of the
        position minus the mean reported velocity) differ from the rates before only by the white
        noise of three messages."""
        rates = (now - before) / interval_s
        rates[:3] -= 0.5 * (now[3:] + before[3:])
        last, self._rates = self._rates, (rates, 1.0 / interval_s)
        if last is None:
            return
        old, new = last[1], 1.0 / interval_s
        squares = (rates - last[0]) ** 2 / (old**2 + (old + new) ** 2 + new**2)
        limit = NOISE_OUTLIER * np.array(self.variances)
        found = np.minimum(squares.reshape(2, 3).mean(axis=1), limit)
        self._variances += min(interval_s / NOISE_TIME_S, 0.1) * (found - self._variances)

    def _estimate_drift(self, span_s: float, now: Array, before: Array) -> None:
        """Update the drift from the mean innovations of two spans, (3,) each."""
        share = span_s / DRIFT_TIME_S
        self._product += share * (_by_axis(now * before) - self._product)
        self._square += share * (_by_axis(0.5 * (now**2 + before**2)) - self._square)
        correlation = self._product / (self._square + VISIBLE_M**2)
        grown = self.drift_mps2 * np.exp(span_s * (correlation - CORRELATED))
        self.drift_mps2 = np.clip(grown, self._least_drift, self._drift_limits)


def _by_axis(ned: Array) -> Array:
    """Return the mean of north and east, and down, of a vector (3,) in NED."""
    return np.array([0.5 * (ned[0] + ned[1]), ned[2]])
