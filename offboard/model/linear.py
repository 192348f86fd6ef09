"""The linear model at hover, torque interface: Eqs. 8-18, continuous and sampled.

States as in Eq. 5, inputs as in Eq. 6 but in deviation from hover [m g, 0, 0, 0]. The matrices are
derivatives of `rigid_body`. For attitude setpoints instead of torques, see `axes`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from offboard.model.axes import LinearModel
from offboard.model.rigid_body import derivative, hover_input, pack
from offboard.model.state import EULER, INPUT_SIZE
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]

_COMPLEX_STEP = 1e-30


def hover_matrices(vehicle: Vehicle) -> tuple[Array, Array]:
    """A (12, 12) and B (12, 4) of Eq. 9 at hover, level, nose north.

    By complex step, f'(x) = Im f(x + ih) / h: exact to rounding, exact zeros where f is decoupled.
    """
    size = EULER.size
    steps = 1j * _COMPLEX_STEP * np.eye(size + INPUT_SIZE)
    slopes = derivative(
        steps[:, :size], hover_input(vehicle) + steps[:, size:], pack(vehicle)
    ).imag.T
    jacobian = slopes / _COMPLEX_STEP
    return jacobian[:, :size], jacobian[:, size:]


def sampled_matrices(vehicle: Vehicle, step_s: float) -> tuple[Array, Array]:
    """A_d (12, 12) and B_d (12, 4) of Eq. 14: zero-order hold over `step_s` seconds."""
    sampled = LinearModel(*hover_matrices(vehicle)).sampled(step_s)
    return sampled.dynamics, sampled.input_map
