"""Motion and memory of the particles, compiled; used by both interfaces of the swarm.

Structure of arrays: positions, velocities and personal bests have shape (n, particles), so that
the innermost loop runs over particles and vectorises. Arrays are changed in place; nothing is
allocated.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import array, entry, kernel
from offboard.control.swarm.lanes import States

Array = NDArray[np.float64]

SEARCH = np.dtype(
    [
        ("inertia", "f8"),
        ("personal", "f8"),
        ("social", "f8"),
        ("damping", "f8"),
        ("rebound", "f8"),
        ("initial_velocity", "f8"),
        # the constant of a quadratic objective
        ("constant", "f8"),
        # iterations done, their limit, and costs that were not finite
        ("iterations", "i8"),
        ("limit", "i8"),
        ("rejected", "i8"),
        # cost of the best particle and spread, Eqs. 28-29
        ("cost", "f8"),
        ("spread", "f8"),
    ],
    align=True,
)
"""Settings and state of one search."""

_SHIFT_A = np.uint64(13)
_SHIFT_B = np.uint64(7)
_SHIFT_C = np.uint64(17)
_HIGH = np.uint64(33)
_LOW_31 = np.uint64(0x7FFFFFFF)
_UNIT_31 = 2.0**-31  # one draw gives two uniform numbers of 31 bits in [0, 1)


@kernel
def _next(x: np.uint64) -> np.uint64:
    """The next state of a random lane (xorshift). The callers turn it into numbers, because loops
    over kernels that return two values are not vectorised."""
    x ^= x << _SHIFT_A
    x ^= x >> _SHIFT_B
    x ^= x << _SHIFT_C
    return x


@entry(SEARCH, array(1, "u8"), array(1), array(1), array(2), array(2))
def scatter(
    searches: Any, lanes: States, lower: Array, upper: Array, positions: Array, velocities: Array
) -> None:
    """Begin a search: uniform positions within the bounds, uniform velocities of either sign."""
    search = searches[0]
    search.iterations = search.rejected = 0
    search.cost = search.spread = np.inf
    initial_velocity = search.initial_velocity
    for j in range(positions.shape[0]):
        low = lower[j]
        high = upper[j]
        width = high - low
        for i in range(positions.shape[1]):
            x = lanes[i] = _next(lanes[i])
            r1 = np.int32(x >> _HIGH) * _UNIT_31
            r2 = np.int32(x & _LOW_31) * _UNIT_31
            positions[j, i] = min(max(low + r1 * width, low), high)
            velocities[j, i] = initial_velocity * (2.0 * r2 - 1.0) * width


@kernel
def move(
    search: Any,
    lanes: States,
    lower: Array,
    upper: Array,
    positions: Array,
    velocities: Array,
    bests: Array,
    leader: Array,
) -> None:
    """Eqs. 30 and 20 with a random number per dimension; Eq. 22 by clamping.

    Where a particle is clamped its velocity is reversed and multiplied by `rebound`. If it were
    kept, the particle would stay at the bound; if it were set to zero, all particles could come to
    rest beside the best one in this dimension.
    """
    inertia, personal, social = search.inertia, search.personal, search.social
    damping, rebound = search.damping, search.rebound
    for j in range(positions.shape[0]):
        low = lower[j]
        high = upper[j]
        target = leader[j]
        for i in range(positions.shape[1]):
            x = lanes[i] = _next(lanes[i])
            r1 = np.int32(x >> _HIGH) * _UNIT_31
            r2 = np.int32(x & _LOW_31) * _UNIT_31
            here = positions[j, i]
            velocity = damping * (
                inertia * velocities[j, i]
                + personal * r1 * (bests[j, i] - here)
                + social * r2 * (target - here)
            )  # Eq. 30
            there = here + velocity  # Eq. 20
            inside = low <= there <= high
            velocities[j, i] = velocity if inside else -rebound * velocity
            positions[j, i] = min(max(there, low), high)  # Eq. 22


@entry(SEARCH, array(1, "u8"), array(1), array(1), array(2), array(2), array(2), array(1))
def move_particles(
    searches: Any,
    lanes: States,
    lower: Array,
    upper: Array,
    positions: Array,
    velocities: Array,
    bests: Array,
    leader: Array,
) -> None:
    """`move` of one SEARCH (1,)."""
    move(searches[0], lanes, lower, upper, positions, velocities, bests, leader)


@kernel
def remember(
    search: Any, costs: Array, positions: Array, bests: Array, best_costs: Array, leader: Array
) -> None:
    """Update personal bests and the leader (best of all); count the iteration and rejected costs.

    Of equal costs the first one found stays the best; a cost that is not finite is rejected.
    """
    dimensions, particles = positions.shape
    leader_cost = search.cost
    rejected = 0
    winner = -1
    for i in range(particles):
        cost = costs[i]
        if not np.isfinite(cost):
            rejected += 1
        elif cost < best_costs[i]:
            best_costs[i] = cost
            for j in range(dimensions):
                bests[j, i] = positions[j, i]
            if cost < leader_cost:
                leader_cost = cost
                winner = i
    if winner >= 0:
        for j in range(dimensions):
            leader[j] = positions[j, winner]
    search.cost = leader_cost
    search.rejected += rejected
    search.iterations += 1


@entry(SEARCH, array(1), array(2), array(2), array(1), array(1))
def learn(
    searches: Any, costs: Array, positions: Array, bests: Array, best_costs: Array, leader: Array
) -> None:
    """`remember`, and the spread."""
    search = searches[0]
    remember(search, costs, positions, bests, best_costs, leader)
    search.spread = spread_about(positions, leader)


@kernel
def spread_about(positions: Array, leader: Array) -> float:
    """Mean distance of all particles from the leader, Eqs. 28-29."""
    dimensions, particles = positions.shape
    total = 0.0
    for i in range(particles):
        squared = 0.0
        for j in range(dimensions):
            squared += (leader[j] - positions[j, i]) ** 2
        total += np.sqrt(squared)
    return float(total / particles)
