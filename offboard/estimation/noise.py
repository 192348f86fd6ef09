"""Noise of telemetry (R) and drift of the disturbance (Q), estimated in flight.

White noise shows in differences of successive measurements in which motion cancels, whatever the
filter makes of them. Innovations that are correlated over a fifth of a second (R. Mehra, 1970) show
a disturbance that drifts faster than configured (gusts); the estimators of PX4 and ArduCopter drift
too, but their innovations are correlated for less. Without noise, those of ArduCopter's EKF3 repeat
with its GPS, at 5 Hz: there the drift grows in calm air too, where a fast one does no harm. Both
estimates are slow, bounded, and never below the configured values.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NOISE_TIME_S = 3.0
NOISE_OUTLIER = 25.0  # limit of a single square, in variances
START_SDS = 0.002, 0.005  # of position (m) and velocity (m/s)
# Innovations are averaged over SPAN_S and correlated with those two spans earlier.
SPAN_S, LONGEST_SPAN_S, DRIFT_TIME_S = 0.1, 0.3, 3.0
CORRELATED = 0.25  # correlation above which the density grows, by e per second for each 1 above
VISIBLE_M = 1e-5  # smaller innovations do not count
# A density of 0.5 to 1.0 after each change of the model was tried. Without noise the error of a
# flight was half as large. With 30 % loss the disturbance followed lost setpoints, and the largest
# error of 50 flights was twice as large.


@dataclass(frozen=True, slots=True)
class Noise:
    """Q by densities per root second, R by standard deviations. Half or twice the values made no
    visible difference on PX4 and ArduCopter, but for the position, which both report with 2e-5 m of
    white noise: with 2 mm predictions from logs of a real PX4 are 6 to 10 % worse, with 0.1 mm
    commands chatter. Noise of position and velocity and drift of the disturbance are estimated in
    flight too, and never less than these; the drift at most `disturbance_limit_mps2`."""

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
    """R of position and velocity, and the drift in Q, from one message after the other.

    `drift_mps2` (2,): drift of the disturbance per root second, lateral and vertical. The vertical
    one is as configured until `permit_vertical_drift`.
    """

    def __init__(self, noise: Noise) -> None:
        self._least = noise.position_sd_m**2, noise.velocity_sd_mps**2
        self._variances = np.square(START_SDS)
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
        position, velocity = self._variances.tolist()
        return max(position, self._least[0]), max(velocity, self._least[1])

    def permit_vertical_drift(self) -> None:
        self._drift_limits[1] = self._drift_limit

    def interrupt(self) -> None:
        """After a jump, a gap or a restart: do not compare the next message with the last."""
        self._last_s = self._began_s = -np.inf
        self._measured: Array | None = None  # of the last message
        self._rates: tuple[Array, float] | None = None  # see `_estimate_noise`
        self._total, self._messages = np.zeros(3), 0  # innovations of position since `_began_s`
        self._means: deque[Array] = deque(maxlen=3)  # of the last spans

    def update(self, time_s: float, innovation: Array, measured: Array) -> None:
        """Use one message of `time_s`: measured less predicted, and measured position (m) and
        velocity (m/s), each (6,), NED."""
        if self._measured is None:
            self._began_s = time_s
        elif time_s > self._last_s:  # else a newer attitude has overtaken both
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
        """The rates of change from one message to the next, of the position less the mean reported
        velocity, differ from the rates before by white noise alone, of three messages."""
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
