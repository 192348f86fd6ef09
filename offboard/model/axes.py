"""The motion of a vehicle with attitude setpoints as its input, and its linear axes. The models
include the attitude loop.

Written in the thrust direction b, a = g e3 - T b - c v + d (`acceleration`): the two lateral axes,
the vertical axis and the heading decouple, and no heading frame is needed. The delay is not part of
these models, because the observer compensates it by prediction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import kernel
from offboard.model.vehicle import AxisResponse, Vehicle

Array = NDArray[np.float64]

# Replaces a lag of zero, with which the input would be a state; far below every period
SHORTEST_THRUST_LAG_S = 1e-3


@kernel
def acceleration(gravity: Any, thrust: Any, drag_ps: Any, velocity: Any, disturbance: Any) -> Any:
    """Return a = g e3 - T b - c v + d, m/s^2, of one axis of NED or of arrays that broadcast.

    `gravity` is g e3 along the axis (0 for north and east), `thrust` T b per unit of mass,
    `drag_ps` c, `velocity` v in m/s, `disturbance` d. The same function solves for the thrust:
    T b = g e3 - a - c v + d, with a in place of T b.
    """
    return gravity - thrust - drag_ps * velocity + disturbance


@dataclass(frozen=True, slots=True)
class LinearModel:
    """x' = A x + B u with `dynamics` A (n, n) and `input_map` B (n, m)."""

    dynamics: Array
    input_map: Array

    def sampled(self, period_s: float) -> LinearModel:
        """Return x(k+1) = A_d x(k) + B_d u(k), with u held for `period_s` (zero-order hold,
        Eq. 14)."""
        import control  # takes a second: imported only to sample a model

        size, count = self.input_map.shape
        plant = control.ss(self.dynamics, self.input_map, np.eye(size), np.zeros((size, count)))
        held = control.c2d(plant, period_s)
        return LinearModel(held.A, held.B)


def lateral_model(vehicle: Vehicle) -> LinearModel:
    """Return one lateral axis: state [p, v, b, b'], input b_c, as deviations. v' = -g b - c v and
    b'' = wn^2 (b_c - b) - 2 z wn b', the tilt response of `AxisResponse`."""
    stiffness = vehicle.tilt.natural_frequency_radps**2
    dynamics = np.zeros((4, 4))
    dynamics[0, 1] = 1.0
    dynamics[1, 1:3] = -vehicle.drag_per_mass_ps, -vehicle.gravity_mps2
    dynamics[2, 3] = 1.0
    dynamics[3, 2] = -stiffness
    dynamics[3, 3] = -2.0 * vehicle.tilt.damping * vehicle.tilt.natural_frequency_radps
    return LinearModel(dynamics, np.array([[0.0], [0.0], [0.0], [stiffness]]))


def vertical_model(vehicle: Vehicle) -> LinearModel:
    """Return the vertical axis: state [z, v_z, f_z], input f_c, as deviations. v_z' = -f_z - c v_z,
    f_z' = (f_c - f_z) / lag; f_z = T b_z is the vertical component of the thrust, m/s^2."""
    rate = 1.0 / max(vehicle.thrust_lag_s, SHORTEST_THRUST_LAG_S)
    drag = vehicle.drag_per_mass_ps
    dynamics = np.array([[0.0, 1.0, 0.0], [0.0, -drag, -1.0], [0.0, 0.0, -rate]])
    return LinearModel(dynamics, np.array([[0.0], [0.0], [rate]]))


def lead(value: Array, rate: Array, acceleration: Array, response: AxisResponse) -> Array:
    """Return the command with which a second-order response without delay follows the given motion:
    s + 2 z / wn s' + s'' / wn^2. Arguments and result have the same shape."""
    frequency = response.natural_frequency_radps
    command: Array = (
        value + (2.0 * response.damping / frequency) * rate + acceleration / frequency**2
    )
    return command


@kernel
def b_z_of(north: float, east: float) -> float:
    """Return the third component of a unit vector, at least 0.1 whatever the other two are."""
    return math.sqrt(max(1.0 - north * north - east * east, 0.01))
