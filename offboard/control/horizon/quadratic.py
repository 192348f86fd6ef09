"""The problem over N decisions for the linear plant: one quadratic in all inputs (condensed).

Inputs are deviations from the `Outlook`: N of b_c north, N of b_c east, N of vertical thrust. The
axes do not couple. Knows no solver.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from offboard.control.gains import CostToGo
from offboard.control.horizon.outlook import Bounds
from offboard.control.law import Task, Tracking
from offboard.control.quadratic import BoxQuadratic

Array = NDArray[np.float64]


class HorizonQuadratic:
    """J of N held inputs and the cost-to-go that follows them, for the gains of `tracking`;
    `problem` fills in the state."""

    def __init__(self, tracking: Tracking, steps: int) -> None:
        self.steps = steps
        lateral = _condense(tracking.lateral, steps)
        self._axes = (lateral, lateral, _condense(tracking.vertical, steps))
        self._hessian: Array = block_diag(*(axis[0] for axis in self._axes))

    def problem(self, task: Task, within: Bounds) -> BoxQuadratic:
        """The quadratic in (3 N,) from the deviations of `task`."""
        starts = (task.lateral[:, 0], task.lateral[:, 1], task.vertical)
        axes = list(zip(starts, self._axes, strict=True))
        gradient = np.concatenate([start @ axis[1] for start, axis in axes])
        rest = sum(float(start @ axis[2] @ start) for start, axis in axes)
        lower, upper = within.lower.T.ravel(), within.upper.T.ravel()
        return BoxQuadratic(self._hessian, gradient, rest, lower, upper)

    def plan(self, stacked: Array) -> Array:
        """Inputs (3 N,) of the problem as (N, 3), one row per step."""
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
