"""Settings and results of a swarm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from offboard.documents.parameters import Parameters

Array = NDArray[np.float64]

EVALUATIONS_MOST = 500_000  # a search of 0.1 s with `pso`, of some seconds with `horizon`


class SwarmSettings(Parameters):
    """The swarm of the paper's section 4.1 with the damping of Table 2.

    `inertia`, `personal` and `social` are w, c1 and c2 of Eq. 19, `damping` is lambda of Eq. 30 (1
    gives Eq. 19). `rebound` is the share of the velocity with which a particle is reflected at a
    bound: with 0 one search in a hundred misses a minimum on the bounds, with 0.5 one in ten
    thousand (40 x 150); but only with 0 epsilon at lambda = 1 equals the paper's.
    `initial_velocity` bounds the first velocities, as a fraction of the distance between the
    bounds. The search ends early when the spread (Eq. 29) falls to `tolerance`, in the unit of the
    inputs; never, if that is 0.
    """

    particles: int = Field(default=40, ge=2, le=10_000)
    iterations: int = Field(default=150, ge=1, le=100_000)
    inertia: float = Field(default=0.9298, ge=0, le=2)
    personal: float = Field(default=1.4986, ge=0, le=4)
    social: float = Field(default=1.4986, ge=0, le=4)
    damping: float = Field(default=0.65, gt=0, le=1)
    rebound: float = Field(default=0.5, ge=0, le=1)
    initial_velocity: float = Field(default=0.5, ge=0, le=1)
    tolerance: float = Field(default=0.0, ge=0)

    @model_validator(mode="after")
    def _ends(self) -> Self:
        evaluations = self.particles * self.iterations
        if evaluations > EVALUATIONS_MOST:
            raise ValueError(
                f"particles x iterations must be at most {EVALUATIONS_MOST}, not {evaluations}"
            )
        return self


@dataclass(frozen=True, slots=True)
class SwarmHistory:
    """Every iteration of one search, for plots.

    positions (iterations, particles, n); costs (iterations,) of the best so far; spreads
    (iterations,), Eq. 29.
    """

    positions: Array
    costs: Array
    spreads: Array


@dataclass(frozen=True, slots=True)
class SwarmResult:
    """The result of one search.

    `best` (n,) is always finite and within the bounds; `cost` is inf if no particle had a finite
    cost. `spread` is epsilon of Eq. 29 in the last iteration, `cut_short` whether the time ran
    out, `rejected` how many costs were not finite.
    """

    best: Array
    cost: float
    spread: float
    iterations: int
    cut_short: bool = False
    rejected: int = 0
    history: SwarmHistory | None = None
