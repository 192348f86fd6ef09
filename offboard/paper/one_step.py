"""Eq. 21 as a quadratic in the input: one step ahead, with any weight of the next state.

With Q as the weight of x(k+1) this is the paper's objective; with the Riccati solution of the same
weights (`cost_to_go`) its minimum is optimal over an infinite horizon. Units are those of the
model.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offboard.control.quadratic import BoxQuadratic

Array = NDArray[np.float64]


class OneStep:
    """J(u) of Eq. 21 for one model and one set of weights; `problem` fills in the state.

    dynamics A (n, n), inputs B (n, m). Weights, all symmetric: terminal W (n, n) of
    x_ref(k+1) - x(k+1), energy R (m, m) of u_nom - u, rate R_du (m, m) of u - u(k-1).
    """

    def __init__(
        self,
        dynamics: ArrayLike,
        inputs: ArrayLike,
        terminal: ArrayLike,
        energy: ArrayLike,
        rate: ArrayLike | None = None,
    ) -> None:
        self._dynamics = np.array(dynamics, np.float64)
        self._inputs = np.array(inputs, np.float64)
        self._terminal = np.array(terminal, np.float64)
        self._energy = np.array(energy, np.float64)
        self._rate = np.zeros_like(self._energy) if rate is None else np.array(rate, np.float64)
        curvature = self._inputs.T @ self._terminal @ self._inputs + self._energy + self._rate
        self._hessian = curvature + curvature.T

    def predict(self, state: Array, inputs: Array) -> Array:
        """x(k+1) (..., n) of states (..., n) and inputs (..., m), Eq. 14."""
        following: Array = state @ self._dynamics.T + inputs @ self._inputs.T
        return following

    def problem(
        self,
        state: Array,
        reference_next: Array,
        nominal: Array,
        previous: Array,
        lower: Array,
        upper: Array,
        *,
        keep_constant: bool = True,
    ) -> BoxQuadratic:
        """The quadratic in u(k) from state x(k) (n,) towards reference_next x_ref(k+1) (n,).

        nominal u_nom, previous u(k-1), lower and upper (Eq. 22): (m,). The constant term does not
        move the minimum, but its rounding limits epsilon of Eq. 29: the paper's epsilon is only
        reproduced with it.
        """
        error = self._dynamics @ state - reference_next
        weighed = self._terminal @ error
        gradient = self._inputs.T @ weighed - self._energy @ nominal - self._rate @ previous
        constant = 0.0
        if keep_constant:
            constant = float(
                error @ weighed
                + nominal @ self._energy @ nominal
                + previous @ self._rate @ previous
            )
        return BoxQuadratic(self._hessian, 2.0 * gradient, constant, lower, upper)
