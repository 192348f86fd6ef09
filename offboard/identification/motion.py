"""How a vehicle moved, and what its thrust and attitude alone would have had it do.

Reported velocity is not used: on PX4 it is not the derivative of the reported position. Knows
arrays and no flight.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import array, entry
from offboard.identification.estimator_noise import SLOWNESS_S
from offboard.identification.trace import (
    NORTH,
    POSITION,
    SENT_AT,
    SENT_THRUST,
    STAMP,
    Trace,
    thinned,
)
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]

STEPS_S = 0.018  # closer positions are thinned: nothing is learnt from them


class Motion:
    """Positions of a trace with the attitude at their times, thinned to what is worth having."""

    def __init__(self, trace: Trace) -> None:
        rows = trace.position[thinned(trace.position[:, STAMP], STEPS_S)]
        inside = (rows[:, STAMP] >= trace.begin_s) & (rows[:, STAMP] <= trace.end_s)
        rows = rows[inside]
        self.times = np.ascontiguousarray(rows[:, STAMP])
        self.positions = np.ascontiguousarray(rows[:, POSITION].T)
        stamps = trace.attitude[:, STAMP]
        self.direction_ne = np.array(
            [np.interp(self.times, stamps, trace.attitude[:, NORTH + axis]) for axis in (0, 1)]
        )
        self.upright = np.sqrt(np.maximum(1.0 - np.sum(self.direction_ne**2, axis=0), 0.01))
        self.sent = np.ascontiguousarray(trace.commands[:, [SENT_AT, SENT_THRUST]])

    def thrust(self, delay_s: float, lag_s: float) -> Array:
        """Thrust (N,) as a fraction of full throttle."""
        out = np.empty_like(self.times)
        lagged_thrust(self.times, self.sent, np.array((delay_s, lag_s)), out)
        return out

    @property
    def spacing_s(self) -> float:
        """Mean time from one position to the next."""
        return float(self.times[-1] - self.times[0]) / (len(self.times) - 1)

    @property
    def speed_mps(self) -> float:
        """Horizontal, root mean square, from positions SLOWNESS_S apart."""
        later = self.times + SLOWNESS_S
        within = later <= self.times[-1]
        if not within.any():
            return 0.0
        moved = [
            np.interp(later[within], self.times, along) - along[within]
            for along in self.positions[:2]
        ]
        return float(np.sqrt(np.mean(np.sum(np.square(moved), axis=0)))) / SLOWNESS_S

    @property
    def usable(self) -> bool:
        return len(self.times) >= 50 and len(self.sent) >= 3


def specific_velocity(motion: Motion, vehicle: Vehicle) -> Array:
    """Velocity (3, N) that thrust, attitude and drag alone give, its mean that of the positions."""
    thrust = vehicle.thrust_max_mps2 * motion.thrust(vehicle.thrust_delay_s, vehicle.thrust_lag_s)
    down = vehicle.gravity_mps2 - thrust * motion.upright
    push = np.vstack((-thrust * motion.direction_ne, down))
    push -= push.mean(axis=1, keepdims=True)  # a constant disturbance
    steps = np.diff(motion.times)
    travelled = motion.positions[:, -1] - motion.positions[:, 0]
    mean = travelled / max(motion.times[-1] - motion.times[0], 1e-3)
    push += vehicle.drag_per_mass_ps * mean[:, None]
    velocity = np.empty_like(push)
    velocity[:, 0] = 0.0
    for i, step_s in enumerate(steps):
        keep = math.exp(-vehicle.drag_per_mass_ps * step_s)
        velocity[:, i + 1] = keep * velocity[:, i] + step_s * push[:, i]
    velocity += (mean - velocity.mean(axis=1))[:, None]
    return velocity


@entry(array(1), array(2), array(1), array(1))
def lagged_thrust(times: Array, sent: Array, delay_and_lag_s: Array, out: Array) -> int:
    """The thrust `out` (N,) at `times`: commands `sent` (M, 2), when and how much, after delay and
    first-order lag, exact."""
    delay_s, lag_s = delay_and_lag_s[0], delay_and_lag_s[1]
    row = 0
    while row + 1 < sent.shape[0] and sent[row + 1, 0] + delay_s <= times[0] - 10.0 * lag_s:
        row += 1
    value = sent[row, 1]
    now = min(sent[row, 0] + delay_s, times[0])
    for i in range(times.shape[0]):
        while now < times[i]:
            following = row + 1
            until = times[i]
            acts = following < sent.shape[0] and sent[following, 0] + delay_s <= until
            if acts:
                until = max(sent[following, 0] + delay_s, now)
            left = math.exp(-(until - now) / lag_s) if lag_s > 1e-6 else 0.0
            value = sent[row, 1] + (value - sent[row, 1]) * left
            now = until
            if acts:
                row = following
        out[i] = value if lag_s > 1e-6 else sent[row, 1]
    return 0
