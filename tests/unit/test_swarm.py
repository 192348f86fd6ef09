"""The swarm finds known minima, by ask/tell and compiled, within box and deadline. The oracle of
its certificate tries all 81 active sets of a box in four dimensions."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from offboard.control.quadratic import BoxQuadratic, ExactMinimum, at_bound
from offboard.control.swarm import Swarm, SwarmResult, SwarmSettings, certify, minimise

Array = NDArray[np.float64]


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def sphere(u: Array) -> Array:
    return np.sum(u**2, axis=-1)


def rosenbrock(u: Array) -> Array:
    return np.sum(100 * (u[..., 1:] - u[..., :-1] ** 2) ** 2 + (1 - u[..., :-1]) ** 2, axis=-1)


def rastrigin(u: Array) -> Array:
    return np.sum(u**2 - 10 * np.cos(2 * np.pi * u) + 10, axis=-1)


def search(
    objective: Callable[[Array], Array], lower: Any, upper: Any, seeds: Array | None = None,
    seed: int = 1, **settings: float,
) -> SwarmResult:  # fmt: skip
    chosen = SwarmSettings(**settings)
    swarm = Swarm(chosen, np.array(lower), np.array(upper), rng(seed), seeds)
    for _ in range(chosen.iterations):
        swarm.tell(objective(swarm.ask()))
    return swarm.result()


MANY = {"particles": 200, "iterations": 300, "damping": 0.8}


@pytest.mark.parametrize(
    ("objective", "lower", "upper", "minimiser", "settings", "tolerance"),
    [
        (sphere, [0.5, -5.0], [3.0, -0.25], [0.5, -0.25], {}, 0.0),  # in a corner
        (rosenbrock, [-2] * 2, [2] * 2, [1, 1], {"iterations": 400, "damping": 0.8}, 1e-3),
        (rastrigin, [-5] * 2, [4] * 2, [0, 0], MANY, 1e-6),
        (rastrigin, [0.6, -5], [4, 4], [0.9949586, 0], MANY, 1e-5),  # global minimum outside
    ],
)
def test_swarm_finds_known_minima(
    objective: Callable[[Array], Array], lower: list[float], upper: list[float],
    minimiser: list[float], settings: dict[str, float], tolerance: float,
) -> None:  # fmt: skip
    for seed in range(5):
        result = search(objective, lower, upper, seed=seed, **settings)
        assert np.abs(result.best - minimiser).max() <= tolerance
        assert result.cost == pytest.approx(float(objective(result.best)), abs=0)


def diagonal_problem(generator: np.random.Generator) -> tuple[BoxQuadratic, Array]:
    """A quadratic without coupling in the box of Eq. 26 and its closed-form minimiser clip(-f/h).

    Curvatures as Eq. 21 has them with Eqs. 24-25; half of the minima rest on a bound.
    """
    upper = np.array([3.942, 0.2, 0.2, 0.1])
    lower = np.array([-4.0, -0.2, -0.2, -0.1])
    h = np.array([0.235, 0.9, 0.9, 3.15]) ** 2 + np.array([1.0057, 2.25, 2.25, 6.0])
    f = h * generator.uniform(1.2 * lower, 1.2 * upper)
    return BoxQuadratic(np.diag(h), f, 1.0, lower, upper), np.clip(-f / h, lower, upper)


def furthest_misses(settings: SwarmSettings, searches: int) -> Array:
    """Largest distance from the closed form per search, as a fraction of the range."""
    generator = np.random.default_rng(2)
    drawn = rng(2)
    misses = np.empty(searches)
    for i in range(searches):
        problem, minimiser = diagonal_problem(generator)
        off = np.abs(minimise(settings, problem, drawn).best - minimiser)
        misses[i] = np.max(off / (problem.upper - problem.lower))
    return misses


def test_500_searches_agree_with_the_closed_form() -> None:
    """Without rebound some searches miss a minimum on the bounds."""
    assert furthest_misses(SwarmSettings(iterations=60), 500).max() < 1e-3
    misses = furthest_misses(SwarmSettings(rebound=0.0), 500)
    assert 1 < np.sum(misses > 1e-3) < 25


def test_seed_particles_are_evaluated_and_clipped_to_the_box() -> None:
    seeds, box = np.array([[0.3, -0.4], [9.0, 9.0]]), ([-1, -1], [1, 1])
    at_seed = search(lambda u: sphere(u - seeds[0]), *box, seeds, iterations=1)
    assert np.array_equal(at_seed.best, seeds[0])
    assert at_seed.cost == 0.0
    in_corner = search(lambda u: -u.sum(axis=-1), *box, seeds, iterations=1)
    assert np.array_equal(in_corner.best, np.ones(2))


def test_non_finite_costs_never_win() -> None:
    def holed(u: Array) -> Array:
        return np.where(u[:, 0] > 0, sphere(u - 0.5), np.array([np.nan, np.inf, -np.inf, 1e308])[
            np.arange(len(u)) % 4
        ])  # fmt: skip

    box = ([-1, -1], [1, 1])
    assert search(holed, *box).best == pytest.approx([0.5, 0.5], abs=1e-6)
    hopeless = search(lambda u: np.full(len(u), np.nan), *box)
    assert hopeless.cost == np.inf
    assert np.all(np.abs(hopeless.best) <= 1)


def test_search_ends_when_its_time_is_over() -> None:
    problem, minimiser = diagonal_problem(np.random.default_rng(10))
    left = iter([0.002, 0.001, 0.0])
    settings = SwarmSettings(iterations=1000)
    result = minimise(settings, problem, rng(10), remaining_s=lambda: next(left))
    assert result.cut_short
    assert result.iterations == 75
    assert np.abs(result.best - minimiser).max() < 1e-3
    for iterations, left_s in ((1000, 1.0), (25, 0.0)):  # the last iteration is not cut short
        whole = minimise(SwarmSettings(iterations=iterations), problem, rng(10), lambda: left_s)  # noqa: B023
        assert (whole.cut_short, whole.iterations) == (False, iterations)


def test_invalid_bounds_are_refused() -> None:
    for lower, upper in (([1.0], [0.0]), ([0.0, 0.0], [1.0]), ([-np.inf], [0.0]), ([], [])):
        with pytest.raises(ValueError, match="bounds must be"):
            Swarm(SwarmSettings(), lower, upper, rng(0))


def test_particle_moves_follow_eqs_30_and_20_and_the_box() -> None:
    """The oracle, for ask/tell and compiled, is the equations in NumPy with the same random
    numbers. The spread (Eqs. 28-29) is the mean distance of the last positions from the best."""
    settings = SwarmSettings(social=1.4, rebound=0.25, inertia=1.9)
    lower, upper = -np.array([0.6, 0.8, 1.0]), np.array([0.7, 0.5, 0.9])
    hessian = np.array([[1.0, 0.3, 0.0], [0.3, 2.0, -0.2], [0.0, -0.2, 3.0]])
    problem = BoxQuadratic(hessian, np.array([1.0, -0.2, 0.4]), 2.0, lower, upper)
    swarm, compiled, drawn = (*(Swarm(settings, lower, upper, rng(1)) for _ in "ab"), rng(1))
    position = lower + (upper - lower) * drawn.random((3, 40)).T
    velocity = 0.5 * (upper - lower) * drawn.uniform(-1, 1, (3, 40)).T
    own, own_cost = position.copy(), np.full(40, np.inf)
    clamped, touched = np.zeros((40, 3), dtype=bool), 0
    for number in range(1, 6):
        assert swarm.ask() == pytest.approx(position, abs=1e-13)
        assert compiled.ask() == pytest.approx(position, abs=1e-13)
        costs = problem(position)
        swarm.tell(costs)
        compiled.tell_all(problem, 1)
        better = costs < own_cost
        own[better], own_cost[better] = position[better], costs[better]
        best = own[np.argmin(own_cost)]
        for result in (swarm.result(), compiled.result()):
            assert result.best == pytest.approx(best, abs=1e-13)
            assert result.cost == pytest.approx(own_cost.min(), rel=1e-12)
            spread = np.linalg.norm(position - best, axis=1).mean()
            assert (result.iterations, result.spread) == (number, pytest.approx(spread, rel=1e-12))
        r1, r2 = drawn.random((3, 40, 2)).transpose(2, 1, 0)
        velocity = np.where(clamped, -0.25 * velocity, velocity)
        pull = 1.4986 * r1 * (own - position) + 1.4 * r2 * (best - position)
        velocity = 0.65 * (1.9 * velocity + pull)
        clamped = (position + velocity < lower) | (position + velocity > upper)
        position = np.clip(position + velocity, lower, upper)
        touched += clamped.sum()
    assert touched > 10


def enumerated_minimum(problem: BoxQuadratic) -> tuple[Array, float]:
    """The feasible stationary point of least cost over all 3^n ways of resting on bounds."""
    best, best_cost = np.empty(0), np.inf
    for pattern in itertools.product((-1, 0, 1), repeat=len(problem.gradient)):
        sides = np.array(pattern)
        u = np.where(sides < 0, problem.lower, problem.upper)
        free = sides == 0
        if free.any():
            known = problem.hessian[np.ix_(free, ~free)] @ u[~free]
            u[free] = np.linalg.solve(
                problem.hessian[np.ix_(free, free)], -problem.gradient[free] - known
            )
        feasible = np.all((problem.lower <= u) & (u <= problem.upper))
        if feasible and float(problem(u)) < best_cost:
            best, best_cost = u, float(problem(u))
    return best, best_cost


def coupled_problem(generator: np.random.Generator, constant: float = 0.0) -> BoxQuadratic:
    root = generator.normal(size=(4, 4)) * 10 ** generator.uniform(-1, 1, 4)
    return BoxQuadratic(
        root @ root.T + 0.01 * np.eye(4),
        generator.normal(size=4) * 10 ** generator.uniform(-1, 2),
        constant,
        -generator.uniform(0.1, 3, 4),
        generator.uniform(0.1, 3, 4),
    )


def answer(problem: BoxQuadratic, inputs: Array) -> SwarmResult:
    return SwarmResult(inputs, float(problem(inputs)), 0.25, 150, cut_short=True)


def test_gap_agrees_with_enumerated_active_sets() -> None:
    generator, exact, active = np.random.default_rng(1), ExactMinimum(4), set()
    for _ in range(150):
        problem = coupled_problem(generator, constant=1000.0)
        minimiser, optimal = enumerated_minimum(problem)
        found = exact.minimise(problem)
        assert found == pytest.approx(minimiser, abs=1e-8)
        resting = int(np.sum((found == problem.lower) | (found == problem.upper)))
        active.add(resting)
        best = certify(problem, answer(problem, minimiser), exact)
        assert 0 <= best.gap < 1e-12
        assert best.at_bound or not resting
        inputs = generator.uniform(problem.lower, problem.upper)
        certificate, cost = certify(problem, answer(problem, inputs), exact), float(problem(inputs))
        assert certificate.optimal_cost == pytest.approx(optimal, rel=1e-9)
        assert certificate.gap == pytest.approx((cost - optimal) / abs(optimal), rel=1e-6, abs=1e-9)
        assert (certificate.cost, certificate.at_bound) == (cost, False)
        assert (certificate.spread, certificate.iterations) == (0.25, 150)
        assert certificate.cut_short
    assert active == {0, 1, 2, 3, 4}


def test_gap_is_accurate_for_large_and_zero_minima() -> None:
    """An error of 1e-6 in each input costs 2e-12, which a float cannot show beside a J of 1e6."""
    large, none = (
        BoxQuadratic(np.eye(4), np.zeros(4), c, -np.ones(4), np.ones(4)) for c in (1e6, 0)
    )
    inputs = np.full(4, 1e-6)
    assert float(large(inputs)) == 1e6
    assert certify(large, answer(large, inputs)).gap == pytest.approx(2e-18, rel=1e-6)
    result = minimise(SwarmSettings(), none, np.random.default_rng(4))
    assert certify(none, result).gap < 1e-9
    half = certify(none, answer(none, np.full(4, 0.5)))
    assert half.optimal_cost == 0.0
    assert half.gap > 1000
    flat = BoxQuadratic(np.zeros((4, 4)), np.zeros(4), 0.0, -np.ones(4), np.ones(4))
    assert certify(flat, answer(flat, np.zeros(4))).gap == 0.0


def test_fixed_input_does_not_count_as_at_its_bound() -> None:
    lower, upper = np.array([-1.0, 0.5, -1.0]), np.array([1.0, 0.5, 1.0])
    problem = BoxQuadratic(np.eye(3), np.zeros(3), 0.0, lower, upper)
    assert not at_bound(problem, np.array([0.0, 0.5, 0.999]))
    assert at_bound(problem, np.array([0.0, 0.5, 1.0]))


def test_non_finite_problem_gives_nan_without_later_errors() -> None:
    exact = ExactMinimum(4)
    sound = BoxQuadratic(np.eye(4), np.full(4, 0.5), 0.0, -np.ones(4), np.ones(4))
    spoilt = BoxQuadratic(np.full((4, 4), np.nan), np.zeros(4), 0.0, sound.lower, sound.upper)
    certificate = certify(spoilt, answer(spoilt, np.zeros(4)), exact)
    assert np.isnan(certificate.gap)
    assert np.isnan(certificate.optimal_cost)
    steep = BoxQuadratic(np.eye(4), np.array([np.nan, 0, 0, 0]), 0.0, sound.lower, sound.upper)
    assert np.isnan(exact.minimise(steep)).all()
    assert exact.minimise(sound) == pytest.approx(np.full(4, -0.5), abs=1e-9)
