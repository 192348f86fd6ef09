"""The paper's law on any plant of Eq. 14: settings, and one input u(k) per state and reference.

J(u) = e'Qe + u'Ru + (u - u(k-1))'R_du(u - u(k-1)),  e = x_ref(k+1) - A x - B u

is Eq. 21, a quadratic in u; the swarm searches its minimum within the bounds of Eq. 22. Knows no
vehicle and no autopilot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from offboard.control.quadratic import BoxQuadratic
from offboard.control.swarm import SwarmResult, SwarmSettings, minimise
from offboard.documents.parameters import Parameters

Array = NDArray[np.float64]
Weight = Annotated[float, Field(ge=0)]
Limit = Annotated[float, Field(gt=0)]
Four = tuple[float, float, float, float]
FourWeights = tuple[Weight, Weight, Weight, Weight]
TwelveWeights = tuple[
    Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight
]

PAPER_STEP_S = 0.1  # with which Eq. 16 is reproduced; the paper prints 0.05
PAPER_MASS_KG = 0.4  # Table 1
PAPER_INERTIA_KGM2 = (0.0196, 0.0196, 0.0264)  # Table 1
PAPER_ARM_M = 0.225  # not in Table 1; Eq. 16 is reproduced only with it


class PaperSettings(Parameters):
    """Weights, bounds and swarm of the paper, by default the final ones (section 4.3).

    States are in the order of Eq. 5, SI (psi in radians). Inputs are those of the paper's vehicle,
    relative to hover. For another vehicle they are scaled so that the same numbers cause the same
    accelerations, and bounds and weights keep their meaning; f_t is limited further where the total
    thrust would be negative or above the vehicle's maximum.
    """

    fitness: TwelveWeights = (1, 1, 25, 1, 1, 1, 20, 20, 5, 20, 20, 5)  # diag Q, Eq. 33
    energy: FourWeights = (0.00057, 0.125, 0.125, 0.5)  # diag R, Eq. 34
    rate: FourWeights = (1, 1, 1, 1)  # diag R_du, Eqs. 25 and 35
    lower: Four = (-4.0, -0.2, -0.2, -0.1)  # N, N, N, N m, Eq. 26
    upper: Four = (3.942, 0.2, 0.2, 0.1)  # Eq. 26
    keep_constant: bool = True  # the constant of J: its rounding makes epsilon of Eq. 29
    swarm: SwarmSettings = SwarmSettings()

    @classmethod
    def first_configuration(cls) -> PaperSettings:
        """Section 4.1: Q = I (Eq. 23 is lost; I gives the paper's magnitudes), R of Eq. 24, no
        damping, and no rebound, which gives the paper's epsilon."""
        return cls(
            fitness=(1,) * 12,
            energy=(0.0057, 1.25, 1.25, 5.0),
            swarm=SwarmSettings(damping=1.0, rebound=0.0),
        )


@dataclass(frozen=True, slots=True)
class Move:
    """The inputs u(k) (4,), the state (12,) they lead to, and how they were found."""

    inputs: Array
    following: Array
    problem: BoxQuadratic
    result: SwarmResult


class PaperLaw:
    """The law on any plant of Eq. 14: dynamics (12, 12), inputs (12, 4), lower and upper (4,).

    Remembers the last input (for R_du) and the random stream; `reset` forgets them. `terminal`
    (12, 12) replaces diag(Q): with the Riccati solution of the same weights the minimum is optimal
    over an infinite horizon.
    """

    def __init__(
        self,
        dynamics: Array,
        inputs: Array,
        settings: PaperSettings,
        lower: Array | None = None,
        upper: Array | None = None,
        terminal: Array | None = None,
        seed: int = 0,
    ) -> None:
        self._settings, self._seed = settings, seed
        self._lower = np.array(settings.lower if lower is None else lower, np.float64)
        self._upper = np.array(settings.upper if upper is None else upper, np.float64)
        weight = np.diag(settings.fitness) if terminal is None else terminal
        self._dynamics, self._inputs, self._weight = dynamics, inputs, weight
        self._rate = np.diag(settings.rate)
        curvature = inputs.T @ weight @ inputs + np.diag(settings.energy) + self._rate
        self._hessian = curvature + curvature.T
        self.reset()

    def reset(self) -> None:
        """Forget the last input, and start the random stream anew."""
        self._previous = np.zeros(len(self._lower))
        self._rng = np.random.default_rng(self._seed)

    def move(
        self,
        state: Array,
        reference_next: Array,
        remaining_s: Callable[[], float] | None = None,
    ) -> Move:
        """u(k) for the state x(k) (12,) towards x_ref(k+1) (12,), Eq. 27; `remaining_s` as in
        `swarm.minimise`."""
        slope = self._slope(state, reference_next)
        problem = BoxQuadratic(self._hessian, *slope, self._lower, self._upper)
        result = minimise(self._settings.swarm, problem, self._rng, remaining_s=remaining_s)
        self._previous = result.best
        following = state @ self._dynamics.T + result.best @ self._inputs.T
        return Move(result.best, following, problem, result)

    def _slope(self, state: Array, reference_next: Array) -> tuple[Array, float]:
        """Gradient (4,) and constant of Eq. 21 at u = 0. The constant does not move the minimum,
        but its rounding limits epsilon of Eq. 29: only with it is epsilon the paper's."""
        error = self._dynamics @ state - reference_next
        weighed, pull = self._weight @ error, self._rate @ self._previous
        gradient = 2.0 * (self._inputs.T @ weighed - pull)
        if not self._settings.keep_constant:
            return gradient, 0.0
        return gradient, float(error @ weighed + self._previous @ pull)
