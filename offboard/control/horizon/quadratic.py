"""The exact problem over N decisions where the plant is linear: one box quadratic, condensed.

Inputs are the deviations of `Outlook`, in the order [north, east, down] x N. The axes do not
couple. Knows no solver.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from offboard.control.cost import BoxQuadratic
from offboard.control.horizon.outlook import Bounds
from offboard.control.riccati import CostToGo

Array = NDArray[np.float64]


class HorizonQuadratic:
    """J of N held inputs and the cost-to-go behind them, for given gains; `problem` fills in the
    state."""

    def __init__(self, lateral: CostToGo, vertical: CostToGo, steps: int) -> None:
        self.steps = steps
        self._lateral = _condense(lateral, steps)
        self._vertical = _condense(vertical, steps)
        self.hessian: Array = block_diag(self._lateral[0], self._lateral[0], self._vertical[0])

    def problem(self, lateral: Array, vertical: Array, within: Bounds) -> BoxQuadratic:
        """From the deviations lateral (4, 2) and vertical (3,) of `tracking.errors`."""
        starts = (lateral[:, 0], lateral[:, 1], vertical)
        models = (self._lateral, self._lateral, self._vertical)
        gradient = np.concatenate(
            [start @ model[1] for start, model in zip(starts, models, strict=True)]
        )
        rest = sum(
            float(start @ model[2] @ start) for start, model in zip(starts, models, strict=True)
        )
        lower, upper = within.lower.T.ravel(), within.upper.T.ravel()
        return BoxQuadratic(self.hessian, gradient, rest, lower, upper)

    def plan(self, stacked: Array) -> Array:
        """Inputs (N, 3) of the problem's (3 N,)."""
        return stacked.reshape(3, self.steps).T


def _condense(to_go: CostToGo, steps: int) -> tuple[Array, Array, Array]:
    """J = 1/2 u' H u + x' F u + x' G x of u (N,) from the state x (n,): H, F (n, N), G (n, n)."""
    size = len(to_go.transition)
    at = np.zeros((size, size + steps))  # the state, as a function of the first one and the inputs
    at[:, :size] = np.eye(size)
    total = np.zeros((size + steps, size + steps))
    for step in range(steps):
        held = np.zeros((1, size + steps))
        held[0, size + step] = 1.0
        both = np.vstack((at, held))
        total += both.T @ to_go.stage @ both
        at = to_go.transition @ at + to_go.input_map @ held
    total += at.T @ to_go.terminal @ at
    return 2.0 * total[size:, size:], 2.0 * total[:size, size:], total[:size, :size]
