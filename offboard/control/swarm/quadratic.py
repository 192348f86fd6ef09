"""The swarm on a `BoxQuadratic`, compiled from the first particle to the answer.

Moves the same particles as `Swarm` does on the same random stream. Knows no clock: it runs in
chunks of iterations and asks between them how much time the caller has left.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from offboard.control.cost import BoxQuadratic
from offboard.control.swarm.lanes import RandomLanes
from offboard.control.swarm.motion import move, remember, scatter, spread_about
from offboard.control.swarm.particles import Box, Swarm, box, place_seeds
from offboard.control.swarm.settings import SwarmHistory, SwarmResult, SwarmSettings

Array = NDArray[np.float64]

CHUNK_ITERATIONS = 25  # between two looks at the time left: about 15 us


@numba.njit(cache=True)
def quadratic_costs(  # type: ignore[no-untyped-def]
    hessian, gradient, constant, positions, costs
) -> None:
    """J of positions (n, particles) into costs (particles,)."""
    if positions.shape[0] == 4:
        _costs_of_four(hessian, gradient, constant, positions, costs)
        return
    costs[:] = constant
    for j in range(positions.shape[0]):
        for i in range(positions.shape[1]):
            slope = gradient[j] + 0.5 * hessian[j, j] * positions[j, i]
            for k in range(j):
                slope += hessian[j, k] * positions[k, i]
            costs[i] += positions[j, i] * slope


@numba.njit(cache=True)
def _costs_of_four(  # type: ignore[no-untyped-def]
    hessian, gradient, constant, positions, costs
) -> None:
    """The same for the four inputs of Eq. 6, unrolled: a third of the time of a search."""
    h00, h11 = 0.5 * hessian[0, 0], 0.5 * hessian[1, 1]
    h22, h33 = 0.5 * hessian[2, 2], 0.5 * hessian[3, 3]
    h10, h20, h21 = hessian[1, 0], hessian[2, 0], hessian[2, 1]
    h30, h31, h32 = hessian[3, 0], hessian[3, 1], hessian[3, 2]
    g0, g1, g2, g3 = gradient[0], gradient[1], gradient[2], gradient[3]
    for i in range(positions.shape[1]):
        a, b, c, d = positions[0, i], positions[1, i], positions[2, i], positions[3, i]
        costs[i] = (
            constant
            + a * (g0 + h00 * a)
            + b * (g1 + h11 * b + h10 * a)
            + c * (g2 + h22 * c + h20 * a + h21 * b)
            + d * (g3 + h33 * d + h30 * a + h31 * b + h32 * c)
        )


@numba.njit(cache=True)
def _iterate(  # type: ignore[no-untyped-def]
    first, last, lanes, lower, upper, inertia, personal, social, damping, rebound,
    positions, velocities, bests, best_costs, leader, leader_cost,
    hessian, gradient, constant, costs,
):  # fmt: skip
    """Iterations first .. last - 1; iteration 0 evaluates where the particles stand."""
    rejected = 0
    for iteration in range(first, last):
        if iteration > 0:
            move(
                lanes, lower, upper, inertia, personal, social, damping, rebound,
                positions, velocities, bests, leader,
            )  # fmt: skip
        quadratic_costs(hessian, gradient, constant, positions, costs)
        leader_cost, fresh = remember(costs, positions, bests, best_costs, leader, leader_cost)
        rejected += fresh
    return leader_cost, rejected, spread_about(positions, leader)


class QuadraticSwarm:
    """Searches for minima of quadratics in `dimensions` inputs; its arrays are made once."""

    def __init__(self, settings: SwarmSettings, dimensions: int) -> None:
        self._settings = settings
        shape = (dimensions, settings.particles)
        self._positions = np.empty(shape)
        self._velocities = np.empty(shape)
        self._bests = np.empty(shape)
        self._best_costs = np.empty(settings.particles)
        self._costs = np.empty(settings.particles)
        self._leader = np.empty(dimensions)
        self._bounds = Box(np.empty(dimensions), np.empty(dimensions))
        self._hessian = np.empty((dimensions, dimensions))
        self._gradient = np.empty(dimensions)
        self._constant = 0.0

    def minimise(
        self,
        problem: BoxQuadratic,
        lanes: RandomLanes,
        seeds: Sequence[ArrayLike] = (),
        remaining_s: Callable[[], float] | None = None,
        keep_history: bool = False,
    ) -> SwarmResult:
        """The best input found in the problem's box.

        `remaining_s` says how many seconds are left; once it says none, the best so far is the
        answer, after one chunk of iterations at the earliest. Raises ValueError on bounds that
        are not finite and ordered, or of another dimension.
        """
        self._start(problem, lanes, seeds)
        limit = self._settings.iterations
        watched = remaining_s is not None or self._settings.tolerance > 0
        chunk = 1 if keep_history else CHUNK_ITERATIONS if watched else limit
        kept: list[tuple[Array, float, float]] = []
        done, cost, rejected, spread, cut_short = 0, np.inf, 0, np.inf, False
        while done < limit:
            reach = min(done + chunk, limit)
            cost, fresh, spread = self._advance(lanes, done, reach, cost)
            done, rejected = reach, rejected + fresh
            if keep_history:
                kept.append((self._positions.T.copy(), cost, spread))
            if spread <= self._settings.tolerance > 0:
                break
            if done < limit and remaining_s is not None and remaining_s() <= 0:
                cut_short = True
                break
        history = _history(kept) if keep_history else None
        return SwarmResult(
            self._leader.copy(), float(cost), float(spread), done, cut_short, rejected, history
        )

    def _start(self, problem: BoxQuadratic, lanes: RandomLanes, seeds: Sequence[ArrayLike]) -> None:
        bounds = box(problem.lower, problem.upper)
        if len(bounds.lower) != len(self._leader):
            raise ValueError(f"{len(bounds.lower)} inputs for a swarm of {len(self._leader)}")
        self._bounds = bounds
        self._hessian[:] = problem.hessian
        self._gradient[:] = problem.gradient
        self._constant = float(problem.constant)
        s = self._settings
        states = lanes.states(s.particles)
        scatter(states, *bounds, s.initial_velocity, self._positions, self._velocities)
        place_seeds(self._positions, seeds, bounds)
        self._bests[:] = self._positions
        self._best_costs.fill(np.inf)
        self._leader[:] = self._positions[:, 0]

    def _advance(
        self, lanes: RandomLanes, first: int, last: int, cost: float
    ) -> tuple[float, int, float]:
        s = self._settings
        answer: tuple[float, int, float] = _iterate(
            first, last, lanes.states(s.particles), *self._bounds,
            s.inertia, s.personal, s.social, s.damping, s.rebound,
            self._positions, self._velocities, self._bests, self._best_costs,
            self._leader, cost, self._hessian, self._gradient, self._constant, self._costs,
        )  # fmt: skip
        return answer


def warm_up() -> None:
    """Call every compiled path of the swarm once, so that none compiles in flight."""
    settings = SwarmSettings(particles=2, iterations=2)
    for dimensions in (2, 4):
        zeros, ones = np.zeros(dimensions), np.ones(dimensions)
        problem = BoxQuadratic(np.eye(dimensions), zeros, 0.0, -ones, ones)
        QuadraticSwarm(settings, dimensions).minimise(problem, RandomLanes(0))
        swarm = Swarm(-ones, ones, settings, RandomLanes(0))
        for _ in range(settings.iterations):
            swarm.tell(problem(swarm.ask()))
        swarm.result()


def _history(kept: list[tuple[Array, float, float]]) -> SwarmHistory:
    positions, costs, spreads = zip(*kept, strict=True)
    return SwarmHistory(np.array(positions), np.array(costs), np.array(spreads))
