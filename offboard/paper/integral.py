"""The integral term that the paper's conclusions propose: the summed tracking error in the cost.

The state of Eq. 5 is extended by xi, the error of [x y z psi] summed over time, and xi(k+1) is
weighted like any other state. The problem stays a quadratic in the same four inputs, so swarm and
certificate are the same. The caller chooses the frame.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from offboard.documents.parameters import Parameters
from offboard.model.state import PSI, X, Z

Array = NDArray[np.float64]

INTEGRATED = (X, X + 1, Z, PSI)  # indices in Eq. 5
Weight = Annotated[float, Field(ge=0)]
Limit = Annotated[float, Field(gt=0)]


class IntegralSettings(Parameters):
    """`weights` of the squared summed errors of x, y, z (m s) and psi (rad s); each sum is kept
    within +-`limits`."""

    weights: tuple[Weight, Weight, Weight, Weight] = (80.0, 80.0, 15.0, 0.0)
    limits: tuple[Limit, Limit, Limit, Limit] = (200.0, 200.0, 200.0, 5.0)


def augmented(dynamics: Array, inputs: Array, step_s: float) -> tuple[Array, Array]:
    """A (16, 16) and B (16, 4) of [x, xi] from A (12, 12) and B (12, 4) of Eq. 14.

    xi(k+1) = xi(k) + step_s S (x(k+1) - x_ref(k+1)), where S selects `INTEGRATED`; the part with
    x_ref is in `augmented_reference`.
    """
    size, count = len(dynamics), len(INTEGRATED)
    summing = step_s * np.eye(size)[list(INTEGRATED)]
    upper = np.hstack([dynamics, np.zeros((size, count))])
    lower = np.hstack([summing @ dynamics, np.eye(count)])
    return np.vstack([upper, lower]), np.vstack([inputs, summing @ inputs])


def augmented_reference(reference_next: Array, step_s: float) -> Array:
    """The reference (16,) of [x, xi] at k+1, x_ref(k+1) (12,) given: xi is 0 in it."""
    return np.concatenate([reference_next, step_s * reference_next[list(INTEGRATED)]])


class ErrorIntegral:
    """xi (4,), summed at each tick. While the input is at its bound (`held`) the sum stops: it
    could not be acted upon and would have to be unwound later."""

    def __init__(self, settings: IntegralSettings, step_s: float) -> None:
        self._limits = np.array(settings.limits, np.float64)
        self._step_s = step_s
        self.value = np.zeros(len(INTEGRATED))

    def add(self, error: Array, held: bool = False) -> Array:
        """Add the error (4,) of this tick, state minus reference, and return the sum."""
        if not held and np.isfinite(error).all():
            total = self.value + self._step_s * error
            self.value = np.clip(total, -self._limits, self._limits)
        return self.value

    def reset(self) -> None:
        """Set the sum to zero."""
        self.value = np.zeros(len(INTEGRATED))
