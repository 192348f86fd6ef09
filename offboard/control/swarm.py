"""The particle swarm of the paper, Eqs. 19-20 and 30: a search for the minimum of any cost within
bounds.

    swarm = Swarm(settings, lower, upper, rng)
    for _ in range(settings.iterations):
        swarm.tell(cost(swarm.ask()))
    answer = swarm.result()

With ask/tell the caller has loop, evaluation and deadline, and any cost can be minimised.
`minimise` searches for the minimum of a quadratic entirely in compiled code, with the same compiled
functions. `certify` computes how far its result is from the exact minimum. This module knows no
model, no reference and no clock.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from offboard.compiled import array, entry, kernel
from offboard.control.base import Certificate
from offboard.control.quadratic import BoxQuadratic, ExactMinimum, at_bound
from offboard.documents.parameters import Parameters

Array = NDArray[np.float64]
Generator = np.random.Generator

EVALUATIONS_MOST = 500_000  # take 0.5 s with `pso` and some seconds with `horizon`
FIRST_VELOCITY = 0.5  # bound of the first velocities, times the distance between the bounds
GAP_FLOOR = 1e-6  # of `certify`, times the variation of the cost within the bounds
CHUNK_ITERATIONS = 25  # `minimise` checks the time that is left after so many, about every 0.1 ms


class SwarmSettings(Parameters):
    """The swarm of the paper's section 4.1 with the damping of Table 2.

    `inertia`, `personal` and `social` are w, c1 and c2 of Eq. 19, `damping` is lambda of Eq. 30 (1
    gives Eq. 19). `rebound` is the share of its velocity with which a particle is reflected at a
    bound: with 0 one search in a hundred misses a minimum on the bounds, with 0.5 one in ten
    thousand (40 particles, 150 iterations). But only with 0 does epsilon at lambda = 1 equal that
    of the paper.
    """

    particles: int = Field(default=40, ge=2, le=10_000)
    iterations: int = Field(default=150, ge=1, le=100_000)
    inertia: float = Field(default=0.9298, ge=0, le=2)
    personal: float = Field(default=1.4986, ge=0, le=4)
    social: float = Field(default=1.4986, ge=0, le=4)
    damping: float = Field(default=0.65, gt=0, le=1)
    rebound: float = Field(default=0.5, ge=0, le=1)

    @model_validator(mode="after")
    def _ends(self) -> Self:
        evaluations = self.particles * self.iterations
        if evaluations > EVALUATIONS_MOST:
            raise ValueError(
                f"particles x iterations must be at most {EVALUATIONS_MOST}, not {evaluations}"
            )
        return self


@dataclass(frozen=True, slots=True)
class SwarmResult:
    """The result of one search.

    `best` (n,) is always finite and within the bounds; `cost` is inf if no particle had a finite
    cost. `spread` is epsilon of Eq. 29 in the last iteration, `cut_short` whether the search ended
    early because no time was left.
    """

    best: Array
    cost: float
    spread: float
    iterations: int
    cut_short: bool = False


SEARCH = np.dtype(
    [(name, "f8") for name in ("inertia", "personal", "social", "damping", "rebound")]
    + [("iterations", "i8"), ("done", "i8"), ("cost", "f8"), ("spread", "f8")],
    align=True,
)
"""Settings and progress of one search: iterations done, lowest cost, spread (Eqs. 28-29)."""

_NO_HESSIAN, _NO_GRADIENT = np.empty((0, 0)), np.empty(0)

# Arguments of the compiled functions: `particles` (3, n, particles) are positions, velocities and
# personal bests; `bounds` (2, n) lower and upper bounds; `best` (n,) the best position of all;
# `costs` (2, particles) the newest and the lowest cost of each particle. Inner loops run over the
# particles, which are adjacent in memory, so that the compiler vectorises them.


@kernel
def _evaluate(
    positions: Array, hessian: Array, gradient: Array, constant: float, costs: Array
) -> None:
    """Compute `costs` (particles,), J = 1/2 u'Hu + f'u + c of each particle."""
    costs[:] = constant
    for j in range(len(gradient)):
        here = positions[j]
        for i in range(len(costs)):
            costs[i] += here[i] * (gradient[j] + 0.5 * hessian[j, j] * here[i])
        for k in range(j):
            for i in range(len(costs)):
                costs[i] += here[i] * hessian[j, k] * positions[k, i]


@kernel
def _remember(search: Any, particles: Array, best: Array, costs: Array) -> None:
    """Update the bests from the newest costs. Of equal costs the first one found stays the best;
    NaN and infinite costs are ignored."""
    for i in range(costs.shape[1]):
        cost = costs[0, i]
        if -np.inf < cost < costs[1, i]:
            costs[1, i] = cost
            particles[2, :, i] = particles[0, :, i]
            if cost < search.cost:
                search.cost = cost
                best[:] = particles[0, :, i]
    search.done += 1


@kernel
def _move(search: Any, random: Array, bounds: Array, particles: Array, best: Array) -> None:
    """Move the particles by Eqs. 30 and 20, with random numbers per dimension, and clamp them to
    the bounds (Eq. 22).

    If a particle is clamped, its velocity is reversed and multiplied by `rebound`. An unchanged
    velocity would keep the particle at the bound; with a velocity of zero all particles could come
    to rest beside the best one in this dimension.
    """
    inertia, damping, rebound = search.inertia, search.damping, search.rebound
    personal, social = search.personal, search.social
    for j in range(particles.shape[1]):
        low, high, target = bounds[0, j], bounds[1, j], best[j]
        positions, velocities, bests = particles[0, j], particles[1, j], particles[2, j]
        for i in range(len(positions)):
            here = positions[i]
            velocity = damping * (
                inertia * velocities[i]
                + personal * random[j, i, 0] * (bests[i] - here)
                + social * random[j, i, 1] * (target - here)
            )  # Eq. 30
            there = here + velocity  # Eq. 20
            velocities[i] = velocity if low <= there <= high else -rebound * velocity
            positions[i] = min(max(there, low), high)  # Eq. 22


@kernel
def _spread(positions: Array, best: Array) -> float:
    """Return the mean distance of the particles from the best position (Eqs. 28-29)."""
    total = 0.0
    for i in range(positions.shape[1]):
        squared = 0.0
        for j in range(len(best)):
            squared += (best[j] - positions[j, i]) ** 2
        total += np.sqrt(squared)
    mean: float = total / positions.shape[1]
    return mean


@entry(
    SEARCH, array(4), array(2), array(3), array(1), array(2), array(2), array(1), float, int
)  # fmt: skip
def iterate(
    searches: Any,
    random: Array,
    bounds: Array,
    particles: Array,
    best: Array,
    costs: Array,
    hessian: Array,
    gradient: Array,
    constant: float,
    iterations: int,
) -> None:
    """Iterate with the costs of a quadratic or, if the gradient is empty, with the newest `costs`.
    After each iteration the particles are moved with `random` (moves, n, particles, 2), except
    after the last iteration of a search."""
    search = searches[0]
    for k in range(iterations):
        if len(gradient) > 0:
            _evaluate(particles[0], hessian, gradient, constant, costs[0])
        _remember(search, particles, best, costs)
        if k == iterations - 1:
            search.spread = _spread(particles[0], best)
        if k < random.shape[0]:
            _move(search, random[k], bounds, particles, best)


class Swarm:
    """One search within `lower` and `upper`, each (n,); equal bounds fix a dimension. The first
    particles start from `seeds` (k, n), clipped to the bounds; the result is never worse than the
    best of them.

    Raises ValueError for bounds that are not finite and ordered vectors of one length.
    """

    def __init__(
        self,
        settings: SwarmSettings,
        lower: ArrayLike,
        upper: ArrayLike,
        rng: Generator,
        seeds: Array | None = None,
    ) -> None:
        self._rng = rng
        self._bounds = bounds = _bounds(lower, upper)
        width = (bounds[1] - bounds[0])[:, None]
        shape = (bounds.shape[1], settings.particles)
        self._particles = np.empty((3, *shape))
        positions, velocities, bests = self._particles
        positions[:] = np.minimum(bounds[0][:, None] + width * rng.random(shape), bounds[1:].T)
        velocities[:] = FIRST_VELOCITY * width * rng.uniform(-1.0, 1.0, shape)
        if seeds is not None:
            positions[:, : len(seeds)] = np.clip(seeds, *bounds).T
        bests[:] = positions
        self._best = positions[:, 0].copy()
        self._costs = np.full((2, settings.particles), np.inf)
        self._search = np.zeros(1, SEARCH)
        for name in ("inertia", "personal", "social", "damping", "rebound", "iterations"):
            self._search[name] = getattr(settings, name)
        self._search["cost"] = self._search["spread"] = np.inf

    def ask(self) -> Array:
        """Return the inputs to evaluate, (particles, n); they are the same until `tell`."""
        positions: Array = self._particles[0].T.copy()
        return positions

    def tell(self, costs: ArrayLike) -> None:
        """Give the costs (particles,) of the inputs returned by `ask`; NaN and -inf count as +inf.

        Raises ValueError for another shape.
        """
        values = np.asarray(costs, np.float64)
        if values.shape != self._costs.shape[1:]:
            raise ValueError(f"{values.shape} costs for {self._costs.shape[1]} particles")
        self._costs[0] = values
        self._iterate(_NO_HESSIAN, _NO_GRADIENT, 0.0, 1)

    def tell_all(self, problem: BoxQuadratic, iterations: int) -> None:
        """Do `iterations` of ask and tell with the costs of `problem`."""
        hessian = np.ascontiguousarray(problem.hessian, np.float64)
        gradient = np.ascontiguousarray(problem.gradient, np.float64)
        self._iterate(hessian, gradient, float(problem.constant), iterations)

    def _iterate(self, hessian: Array, gradient: Array, constant: float, iterations: int) -> None:
        left = int(self._search["iterations"][0] - self._search["done"][0])
        moves = max(min(iterations, left - 1), 0)
        random = self._rng.random((moves, *self._particles.shape[1:], 2))
        iterate(
            self._search, random, self._bounds, self._particles, self._best, self._costs,
            hessian, gradient, constant, iterations,
        )  # fmt: skip

    def result(self, cut_short: bool = False) -> SwarmResult:
        """Return the result so far."""
        search = self._search[0]
        return SwarmResult(
            self._best.copy(),
            cost=float(search["cost"]),
            spread=float(search["spread"]),
            iterations=int(search["done"]),
            cut_short=cut_short,
        )


def minimise(
    settings: SwarmSettings,
    problem: BoxQuadratic,
    rng: Generator,
    remaining_s: Callable[[], float] | None = None,
) -> SwarmResult:
    """Search for the minimum of a quadratic within its bounds.

    `remaining_s` returns how many seconds are left; when none are, the search ends with the best
    input so far, after CHUNK_ITERATIONS at the earliest. Raises ValueError for bounds that are not
    finite and ordered.
    """
    swarm, left = Swarm(settings, problem.lower, problem.upper, rng), settings.iterations
    while True:
        swarm.tell_all(problem, min(left, CHUNK_ITERATIONS))
        left -= CHUNK_ITERATIONS
        late = left > 0 and remaining_s is not None and remaining_s() <= 0
        if late or left <= 0:
            return swarm.result(cut_short=late)


def _bounds(lower: ArrayLike, upper: ArrayLike) -> Array:
    """Return the checked lower and upper bounds, (2, n)."""
    low, high = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    if low.ndim != 1 or low.shape != high.shape or not low.size:
        raise ValueError(f"bounds must be two equal vectors, got {low.shape} and {high.shape}")
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low <= high).all()):
        raise ValueError(f"bounds must be finite and ordered, got {low} and {high}")
    return np.stack((low, high))


def certify(
    problem: BoxQuadratic, result: SwarmResult, exact: ExactMinimum | None = None
) -> Certificate:
    """Return the certificate of `result` for `problem`. Pass `exact` to reuse its workspace.

    The gap is (J - J*) / max(|J*|, floor). J - J* is not computed as the difference of two costs,
    which near the optimum would consist of rounding errors, but from the expansion about the
    minimiser: g*'d + 1/2 d'Hd with d = u - u* and g* = Hu* + f. A negative value (the swarm is
    better than daqp's tolerance) counts as 0. The floor is a millionth of the variation of J within
    the bounds; it keeps the gap meaningful exactly on the reference, where J* is zero.
    """
    exact = exact or ExactMinimum(len(problem.gradient))
    best = exact.minimise(problem)
    optimal = float(problem(best))
    off = result.best - best
    slope = problem.hessian @ best + problem.gradient
    excess = float(slope @ off + 0.5 * off @ problem.hessian @ off)
    width, middle = problem.upper - problem.lower, 0.5 * (problem.lower + problem.upper)
    steepness = np.abs(problem.hessian @ middle + problem.gradient)
    variation = float(steepness @ width + width @ np.abs(problem.hessian) @ width / 8)
    scale = max(abs(optimal), GAP_FLOOR * variation)
    gap = max(excess, 0.0) / scale if scale > 0 else (0.0 if scale == 0 else float("nan"))
    return Certificate(
        cost=result.cost,
        optimal_cost=optimal,
        gap=gap,
        spread=result.spread,
        iterations=result.iterations,
        cut_short=result.cut_short,
        at_bound=at_bound(problem, result.best),
    )
