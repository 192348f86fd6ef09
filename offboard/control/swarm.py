"""The particle swarm of Eqs. 19-20 and 30: a search for the minimum of any cost within bounds.

    swarm = Swarm(settings, lower, upper, rng)
    for _ in range(settings.iterations):
        swarm.tell(cost(swarm.ask()))
    answer = swarm.result()

With ask/tell the caller owns loop, evaluation and deadline, for any cost. `minimise` searches the
minimum of a quadratic entirely in compiled code, and `certify` says how far its answer is from the
exact minimum. Both move their particles by the same compiled functions. Knows no model, no
reference and no clock.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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

EVALUATIONS_MOST = 500_000  # a search of 0.5 s with `pso`, of some seconds with `horizon`
GAP_FLOOR = 1e-6  # of `certify`, times the variation of the cost within the bounds
CHUNK_ITERATIONS = 25  # of `minimise` between two looks at the time that is left, about 0.1 ms


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


SEARCH = np.dtype(
    [(name, "f8") for name in ("inertia", "personal", "social", "damping", "rebound", "cost")]
    + [("spread", "f8"), ("iterations", "i8"), ("rejected", "i8")],
    align=True,
)
"""Settings and progress of one search: cost of the best, spread (Eqs. 28-29), iterations done, and
costs that were not finite."""

# Compiled: the particles are (3, n, particles), their positions, velocities and personal bests;
# `bounds` (2, n) lower and upper; `best` (n,) the best position of all; `costs` (2, particles) the
# newest and the least of each particle.


@kernel
def _move(search: Any, rng: Generator, bounds: Array, particles: Array, best: Array) -> None:
    """Eqs. 30 and 20 with a random number per dimension; Eq. 22 by clamping.

    Where a particle is clamped its velocity is reversed and multiplied by `rebound`. If it were
    kept, the particle would stay at the bound; if it were set to zero, all particles could come to
    rest beside the best one in this dimension.
    """
    for j in range(particles.shape[1]):
        low, high = bounds[0, j], bounds[1, j]
        for i in range(particles.shape[2]):
            here = particles[0, j, i]
            velocity = search.damping * (
                search.inertia * particles[1, j, i]
                + search.personal * rng.random() * (particles[2, j, i] - here)
                + search.social * rng.random() * (best[j] - here)
            )  # Eq. 30
            there = here + velocity  # Eq. 20
            particles[1, j, i] = velocity if low <= there <= high else -search.rebound * velocity
            particles[0, j, i] = min(max(there, low), high)  # Eq. 22


@kernel
def _remember(search: Any, costs: Array, particles: Array, best: Array) -> None:
    """Update the bests from the newest costs. Of equal costs the first one found stays the best; a
    cost that is not finite is rejected."""
    for i in range(costs.shape[1]):
        cost = costs[0, i]
        if not np.isfinite(cost):
            search.rejected += 1
        elif cost < costs[1, i]:
            costs[1, i] = cost
            is_best = cost < search.cost
            if is_best:
                search.cost = cost
            for j in range(len(best)):
                particles[2, j, i] = particles[0, j, i]
                if is_best:
                    best[j] = particles[0, j, i]
    search.iterations += 1


@kernel
def _spread(particles: Array, best: Array) -> float:
    """Mean distance of all particles from the best position, Eqs. 28-29."""
    total = 0.0
    for i in range(particles.shape[2]):
        squared = 0.0
        for j in range(len(best)):
            squared += (best[j] - particles[0, j, i]) ** 2
        total += np.sqrt(squared)
    return float(total / particles.shape[2])


@entry(SEARCH, Generator, array(2), array(3), array(1))
def move(searches: Any, rng: Generator, bounds: Array, particles: Array, best: Array) -> None:
    """Move all particles once."""
    _move(searches[0], rng, bounds, particles, best)


@entry(SEARCH, array(2), array(3), array(1))
def remember(searches: Any, costs: Array, particles: Array, best: Array) -> None:
    """Take over the newest costs."""
    search = searches[0]
    _remember(search, costs, particles, best)
    search.spread = _spread(particles, best)


@entry(
    SEARCH, Generator, array(2), array(3), array(1), array(2), array(2), array(1), float, int
)  # fmt: skip
def search_quadratic(
    searches: Any,
    rng: Generator,
    bounds: Array,
    particles: Array,
    best: Array,
    costs: Array,
    hessian: Array,
    gradient: Array,
    constant: float,
    iterations: int,
) -> None:
    """Iterate on J = 1/2 u'Hu + f'u + c until `iterations` are done. The first one evaluates the
    particles where they start."""
    search, size = searches[0], len(gradient)
    while search.iterations < iterations:
        if search.iterations > 0:
            _move(search, rng, bounds, particles, best)
        for i in range(costs.shape[1]):
            costs[0, i] = constant
            for j in range(size):
                slope = gradient[j] + 0.5 * hessian[j, j] * particles[0, j, i]
                for k in range(j):
                    slope += hessian[j, k] * particles[0, k, i]
                costs[0, i] += particles[0, j, i] * slope
        _remember(search, costs, particles, best)
    search.spread = _spread(particles, best)


class Swarm:
    """One search within `lower` and `upper`, each (n,); equal bounds fix a dimension. The first
    particles start from `seeds`, (n,) each, clamped to the bounds: the answer is never worse than
    the best of them. Seeds that are not finite, and more seeds than particles, are ignored.

    Raises ValueError for bounds that are not finite and ordered vectors of one length.
    """

    def __init__(
        self,
        settings: SwarmSettings,
        lower: ArrayLike,
        upper: ArrayLike,
        rng: Generator,
        seeds: Sequence[ArrayLike] = (),
    ) -> None:
        self._settings, self._rng = settings, rng
        self._bounds = bounds = _bounds(lower, upper)
        width = (bounds[1] - bounds[0])[:, None]
        shape = (bounds.shape[1], settings.particles)
        self._particles = np.empty((3, *shape))
        self._particles[0] = np.minimum(
            bounds[0][:, None] + width * rng.random(shape), bounds[1:].T
        )
        self._particles[1] = settings.initial_velocity * width * rng.uniform(-1.0, 1.0, shape)
        vectors = (np.asarray(seed, np.float64) for seed in seeds)
        usable = [seed for seed in vectors if np.isfinite(seed).all()]
        for i, seed in enumerate(usable[: settings.particles]):
            self._particles[0, :, i] = np.clip(seed, *bounds)
        self._particles[2] = self._particles[0]
        self._best = self._particles[0, :, 0].copy()
        self._costs = np.full((2, settings.particles), np.inf)
        self._search = np.zeros(1, SEARCH)
        for name in ("inertia", "personal", "social", "damping", "rebound"):
            self._search[name] = getattr(settings, name)
        self._search["cost"] = self._search["spread"] = np.inf
        self._told = False

    def ask(self) -> Array:
        """Inputs to evaluate, (particles, n); the same until `tell` is called."""
        if self._told:
            move(self._search, self._rng, self._bounds, self._particles, self._best)
            self._told = False
        return self.positions

    @property
    def positions(self) -> Array:
        """Where the particles are, (particles, n)."""
        positions: Array = self._particles[0].T.copy()
        return positions

    def tell(self, costs: ArrayLike) -> None:
        """Give the costs (particles,) of the inputs returned by `ask`; NaN and -inf count as +inf.

        Raises ValueError for another shape, or where `ask` was not called since the last `tell`.
        """
        values = np.asarray(costs, np.float64)
        if self._told:
            raise ValueError("tell without ask: these inputs already have their costs")
        if values.shape != self._costs.shape[1:]:
            raise ValueError(f"{values.shape} costs for {self._costs.shape[1]} particles")
        self._costs[0] = values
        remember(self._search, self._costs, self._particles, self._best)
        self._told = True

    def iterate(self, problem: BoxQuadratic, iterations: int) -> None:
        """`ask` and `tell` with the costs of `problem` until `iterations` are done."""
        search_quadratic(
            self._search, self._rng, self._bounds, self._particles, self._best, self._costs,
            np.ascontiguousarray(problem.hessian, np.float64),
            np.ascontiguousarray(problem.gradient, np.float64),
            float(problem.constant), iterations,
        )  # fmt: skip
        self._told = True

    @property
    def spread(self) -> float:
        """Epsilon of Eq. 29 after the last iteration."""
        return float(self._search["spread"][0])

    def result(self, cut_short: bool = False, history: SwarmHistory | None = None) -> SwarmResult:
        """The best input so far."""
        found = self._search[0]
        return SwarmResult(
            self._best.copy(),
            cost=float(found["cost"]),
            spread=self.spread,
            iterations=int(found["iterations"]),
            cut_short=cut_short,
            rejected=int(found["rejected"]),
            history=history,
        )


def minimise(
    settings: SwarmSettings,
    problem: BoxQuadratic,
    rng: Generator,
    seeds: Sequence[ArrayLike] = (),
    remaining_s: Callable[[], float] | None = None,
    keep_history: bool = False,
) -> SwarmResult:
    """The best input found within the bounds of a quadratic.

    `remaining_s` returns how many seconds are left; when none are, the search ends with the best so
    far, after one chunk of iterations at the earliest. `keep_history` keeps every iteration. Raises
    ValueError for bounds that are not finite and ordered.
    """
    swarm = Swarm(settings, problem.lower, problem.upper, rng, seeds)
    limit, tolerance = settings.iterations, settings.tolerance
    watched = remaining_s is not None or tolerance > 0
    chunk = 1 if keep_history else CHUNK_ITERATIONS if watched else limit
    kept: list[tuple[Array, float, float]] = []
    cut_short = False
    for done in range(chunk, limit + chunk, chunk):
        swarm.iterate(problem, min(done, limit))
        if keep_history:
            now = swarm.result()
            kept.append((swarm.positions, now.cost, now.spread))
        if tolerance > 0 and swarm.spread <= tolerance:
            break
        if done < limit and remaining_s is not None and remaining_s() <= 0:
            cut_short = True
            break
    if not keep_history:
        return swarm.result(cut_short)
    positions, costs, spreads = (np.array(each) for each in zip(*kept, strict=True))
    return swarm.result(cut_short, SwarmHistory(positions, costs, spreads))


def _bounds(lower: ArrayLike, upper: ArrayLike) -> Array:
    """Lower and upper, (2, n)."""
    low, high = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    if low.ndim != 1 or low.shape != high.shape or not low.size:
        raise ValueError(f"bounds must be two equal vectors, got {low.shape} and {high.shape}")
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low <= high).all()):
        raise ValueError(f"bounds must be finite and ordered, got {low} and {high}")
    return np.stack((low, high))


def certify(
    problem: BoxQuadratic, result: SwarmResult, exact: ExactMinimum | None = None
) -> Certificate:
    """The certificate of `result`, the answer to `problem`. Pass `exact` to reuse its workspace.

    The gap is (J - J*) / max(|J*|, floor). J - J* is not computed as the difference of two costs,
    which near the optimum would be rounding errors only, but from the expansion about the
    minimiser: g*'d + 1/2 d'Hd with d = u - u* and g* = Hu* + f. A negative value (the swarm is
    better than daqp's tolerance) counts as 0. The floor is a millionth of the variation of J within
    the bounds; it keeps the gap meaningful exactly on the reference, where J* vanishes.
    """
    exact = exact or ExactMinimum(len(problem.gradient))
    best = exact.minimise(problem)
    optimal = float(problem(best))
    off = result.best - best
    slope = problem.hessian @ best + problem.gradient
    excess = float(slope @ off + 0.5 * off @ problem.hessian @ off)
    scale = max(abs(optimal), GAP_FLOOR * _variation(problem))
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


def _variation(problem: BoxQuadratic) -> float:
    """An upper estimate of the variation of J within the bounds."""
    width = problem.upper - problem.lower
    middle = 0.5 * (problem.lower + problem.upper)
    slope = problem.hessian @ middle + problem.gradient
    return float(np.abs(slope) @ width + width @ np.abs(problem.hessian) @ width / 8)
