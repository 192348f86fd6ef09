"""Hover thrust of a vehicle that flies by itself, from its own thrust and its vertical motion.

Before setpoints replace an autopilot's own take-off, or its mode of a vehicle found in the air,
the thrust that it reports (ATTITUDE_TARGET) and its acceleration show the thrust that hovers,
whatever the vehicle file says and however fast it climbs.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from offboard.model.axes import acceleration
from offboard.model.vehicle import HOVER_THRUST_LIMITS, Vehicle

Array = NDArray[np.float64]

WINDOW_S, KEPT_S = 0.5, 1.5
GROUND_M = 0.2  # lower, the ground may carry it
LEAST_THRUSTS, LEAST_SPEEDS, LEAST_S = 3, 8, 0.25  # in the window
LEAST_LIFT = 0.3  # of the weight: less shows too little of the thrust
SETTLED = 0.02  # of a vehicle that has flown by itself for long
DIFFERENT = 0.1  # of the hover thrust: a smaller difference is left to the observer


class HoverEstimate:
    """Thrust reported and vertical speed of the last KEPT_S, by vehicle time."""

    def __init__(self) -> None:
        self._thrusts: deque[tuple[float, ...]] = deque()  # time, thrust, its vertical part
        self._speeds: deque[tuple[float, ...]] = deque()  # time, speed down

    def on_thrust(self, time_s: float, thrust: float, lift: float) -> None:
        """The autopilot reports its collective thrust, 0 .. 1; `lift` is its vertical part."""
        _append(self._thrusts, (time_s, thrust, lift))

    def on_position(self, time_s: float, height_m: float, down_mps: float) -> None:
        """Height above the ground, and vertical velocity, positive down."""
        if height_m < GROUND_M:
            self._speeds.clear()
            return
        _append(self._speeds, (time_s, down_mps))

    def thrust(self, time_s: float) -> float | None:
        """Mean of the thrust that was reported in the WINDOW_S before `time_s`; None without."""
        thrusts = _within(self._thrusts, time_s - WINDOW_S, time_s)
        return float(np.mean(thrusts[:, 1])) if len(thrusts) else None

    def hover_thrust(self, vehicle: Vehicle, time_s: float) -> float | None:
        """The normalised thrust that holds the weight, from the WINDOW_S before `time_s`; None if
        too little was reported in it, or the vehicle falls. Delay, lag and drag are `vehicle`'s:
        a_down = g (1 - u_lift / u_h) - c v_down."""
        speeds = _within(self._speeds, time_s - WINDOW_S, time_s)
        if len(speeds) < LEAST_SPEEDS or speeds[-1, 0] - speeds[0, 0] < LEAST_S:
            return None
        late_s = vehicle.thrust_delay_s + vehicle.thrust_lag_s
        thrusts = _within(self._thrusts, speeds[0, 0] - late_s, time_s - late_s)
        if len(thrusts) < LEAST_THRUSTS:
            return None
        gravity_mps2 = vehicle.gravity_mps2
        a_down_mps2 = float(np.polyfit(speeds[:, 0] - time_s, speeds[:, 1], 1)[0])
        down_mps = float(np.mean(speeds[:, 1]))
        lift_mps2 = acceleration(
            gravity_mps2, a_down_mps2, vehicle.drag_per_mass_ps, down_mps, 0.0
        )  # solved for the thrust
        if lift_mps2 < LEAST_LIFT * gravity_mps2:
            return None
        share = float(np.mean(thrusts[:, 2])) * gravity_mps2 / lift_mps2
        return share if HOVER_THRUST_LIMITS[0] <= share <= HOVER_THRUST_LIMITS[1] else None


def differs(hover_thrust: float, vehicle: Vehicle, least: float = DIFFERENT) -> bool:
    """Whether `hover_thrust` differs from `vehicle`'s by more than the observer should correct."""
    return abs(hover_thrust / vehicle.hover_thrust - 1.0) > least


def _append(samples: deque[tuple[float, ...]], sample: tuple[float, ...]) -> None:
    samples.append(sample)
    while samples[0][0] < sample[0] - KEPT_S:
        samples.popleft()


def _within(samples: deque[tuple[float, ...]], begin_s: float, end_s: float) -> Array:
    kept = [each for each in samples if begin_s <= each[0] <= end_s]
    return np.array(kept, dtype=np.float64)
