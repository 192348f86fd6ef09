"""The linear model at hover, torque interface: Eqs. 8-18, continuous and sampled.

States as in Eq. 5, inputs as in Eq. 6 but in deviation from hover [m g, 0, 0, 0]; C = I, D = 0.
The matrices are differentiated from the one rigid body, not written down a second time.
Knows no attitude loop: that is the other interface.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

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


def hover_system(vehicle: Vehicle) -> Any:
    """Eqs. 9-13 as a `control.StateSpace` with named states and inputs."""
    import control  # here, because it brings in matplotlib: a second nobody else need wait

    a, b = hover_matrices(vehicle)
    return control.ss(
        a,
        b,
        np.eye(EULER.size),
        np.zeros_like(b),
        states=["phi", "theta", "psi", "p", "q", "r", "u", "v", "w", "x", "y", "z"],
        inputs=["thrust", "tau_x", "tau_y", "tau_z"],
    )


def sampled_matrices(vehicle: Vehicle, step_s: float) -> tuple[Array, Array]:
    """A_d (12, 12) and B_d (12, 4) of Eq. 14: zero-order hold over `step_s` seconds (c2d)."""
    import control

    sampled = control.sample_system(hover_system(vehicle), step_s, method="zoh")
    return np.asarray(sampled.A), np.asarray(sampled.B)
