"""The law of motion against Eqs. 20 and 30 written down again in NumPy, and its random stream."""

from __future__ import annotations

import numpy as np
import pytest

from offboard.control.cost import BoxQuadratic
from offboard.control.swarm import QuadraticSwarm, RandomLanes, Swarm, SwarmSettings
from offboard.control.swarm.motion import SEARCH, move_particles, scatter
from offboard.control.swarm.quadratic import quadratic_costs

PARTICLES = 40


def uniform_pairs(lanes: RandomLanes, rows: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """The next `rows` pairs of uniform numbers per lane, by Python's integers (Marsaglia 2003)."""
    mask = (1 << 64) - 1
    pairs = []
    states = [int(s) for s in lanes.states(PARTICLES)]
    for _ in range(rows):
        for i, x in enumerate(states):
            x ^= x << 13 & mask
            x ^= x >> 7
            x ^= x << 17 & mask
            states[i] = x
        high = np.array([(x >> 33) / 2**31 for x in states])
        low = np.array([(x & (2**31 - 1)) / 2**31 for x in states])
        pairs.append((high, low))
    return pairs


def test_one_move_is_eq_30_then_eq_20_then_the_box() -> None:
    generator = np.random.default_rng(1)
    lower, upper = -generator.uniform(0.5, 1, 4), generator.uniform(0.5, 1, 4)
    positions = generator.uniform(lower, upper, (PARTICLES, 4)).T.copy()
    velocities = generator.normal(size=(4, PARTICLES))
    bests = generator.uniform(lower, upper, (PARTICLES, 4)).T.copy()
    leader = bests[:, 3].copy()
    expected_velocities, expected = np.empty((4, PARTICLES)), np.empty((4, PARTICLES))
    for j, (r1, r2) in enumerate(uniform_pairs(RandomLanes(1), 4)):
        v = 0.65 * (
            0.9298 * velocities[j]
            + 1.4986 * r1 * (bests[j] - positions[j])
            + 1.4 * r2 * (leader[j] - positions[j])
        )
        x = positions[j] + v
        expected_velocities[j] = np.where((x < lower[j]) | (x > upper[j]), -0.25 * v, v)
        expected[j] = np.clip(x, lower[j], upper[j])
    lanes, search = RandomLanes(1).states(PARTICLES), np.zeros(1, SEARCH)
    search[["inertia", "personal", "social", "damping", "rebound"]] = (
        0.9298, 1.4986, 1.4, 0.65, 0.25,
    )  # fmt: skip
    move_particles(search, lanes, lower, upper, positions, velocities, bests, leader)
    assert np.any((expected == lower[:, None]) | (expected == upper[:, None]))
    assert positions == pytest.approx(expected, rel=0, abs=1e-15)
    assert velocities == pytest.approx(expected_velocities, rel=0, abs=1e-15)


def test_particles_start_all_over_the_box_with_velocities_of_either_sign() -> None:
    lower, upper = np.array([-1.0, 10.0]), np.array([1.0, 14.0])
    positions, velocities = np.empty((2, 4000)), np.empty((2, 4000))
    search, lanes = np.zeros(1, SEARCH), RandomLanes(2).states(4000)
    search["initial_velocity"] = 0.1
    scatter(search, lanes, lower, upper, positions, velocities)
    place = (positions.T - lower) / (upper - lower)
    assert place.min() >= 0
    assert place.max() <= 1
    for j in range(2):
        counts, _ = np.histogram(place[:, j], 10, (0, 1))
        assert np.sum((counts - 400) ** 2 / 400) < 27.9  # chi squared, 9 degrees, 0.1 %
    assert abs(np.corrcoef(place.T)[0, 1]) < 0.05
    assert abs(np.corrcoef(place[:, 0], velocities[0])[0, 1]) < 0.05
    assert np.abs(velocities).max(axis=1) == pytest.approx([0.2, 0.4], rel=0.01)
    assert np.abs(velocities.mean(axis=1)).max() < 0.015


@pytest.mark.parametrize("dimensions", [1, 3, 4, 6])
def test_compiled_and_ask_tell_move_the_same_particles(dimensions: int) -> None:
    generator = np.random.default_rng(dimensions)
    root = generator.normal(size=(dimensions, dimensions))
    problem = BoxQuadratic(
        root @ root.T + np.eye(dimensions),
        generator.normal(size=dimensions),
        2.0,
        -generator.uniform(0.1, 1, dimensions),
        generator.uniform(0.1, 1, dimensions),
    )
    settings = SwarmSettings()
    compiled = QuadraticSwarm(settings, dimensions).minimise(
        problem, RandomLanes(3), keep_history=True
    )
    assert compiled.history is not None
    swarm = Swarm(problem.lower, problem.upper, settings, RandomLanes(3))
    costs = np.empty(settings.particles)
    for positions in compiled.history.positions:
        asked = swarm.ask()
        assert np.array_equal(asked, positions)
        quadratic_costs(problem.hessian, problem.gradient, problem.constant, asked.T.copy(), costs)
        assert costs == pytest.approx(problem(asked), rel=1e-12)
        swarm.tell(costs)
    told = swarm.result()
    assert np.array_equal(told.best, compiled.best)
    assert (told.cost, told.spread) == (compiled.cost, compiled.spread)


def test_callers_may_hand_in_any_array() -> None:
    """Machine code takes contiguous arrays of doubles only: what callers have is copied."""
    frozen, strided, single = np.asfortranarray(np.eye(4)), np.ones(8)[::2], np.float32(1)
    for array in (frozen, strided):
        array.setflags(write=False)
    plain = BoxQuadratic(np.eye(4), np.ones(4), 1.0, -np.ones(4), np.ones(4))
    problem = BoxQuadratic(frozen, strided, single, -strided, strided)  # type: ignore[arg-type]
    found = [
        QuadraticSwarm(SwarmSettings(), 4).minimise(each, RandomLanes(4), remaining_s=lambda: 1.0)
        for each in (plain, problem)
    ]
    assert found[0].best.tolist() == found[1].best.tolist()
    swarms = [
        Swarm(-each, each, SwarmSettings(inertia=1), RandomLanes(4), (each,))
        for each in (np.ones(4), strided)
    ]
    for costs in np.random.default_rng(4).normal(size=(3, 80)):
        assert swarms[0].ask().tolist() == swarms[1].ask().tolist()
        swarms[0].tell(costs[::2].copy())
        swarms[1].tell(costs[::2])
    assert 0 < swarms[0].spread == swarms[1].spread


def test_a_strided_array_is_refused() -> None:
    lanes, box, particles = RandomLanes(4).states(3), np.ones(2), np.empty((2, 6))
    search = np.zeros(1, SEARCH)
    with pytest.raises(TypeError, match=r"No matching definition.*array\(float64, 2d, A\)"):
        scatter(search, lanes, box, box, particles[:, ::2], particles[:, :3])


def test_a_lane_does_not_depend_on_how_many_are_in_use() -> None:
    grown, whole = RandomLanes(5), RandomLanes(5)
    grown.states(3)
    assert np.array_equal(grown.states(40), whole.states(40))
    assert len(set(whole.states(10_000).tolist())) == 10_000
    assert np.all(whole.states(10_000) != 0)
    assert not np.array_equal(RandomLanes(6).states(40), whole.states(40))


def test_a_seed_beyond_64_bits_is_refused() -> None:
    for seed in (-1, 2**64):
        with pytest.raises(ValueError, match="seed must be"):
            RandomLanes(seed)
