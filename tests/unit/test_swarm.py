"""The swarm finds known minima, by ask/tell and compiled, and keeps its promises."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from offboard.control.cost import BoxQuadratic
from offboard.control.swarm import QuadraticSwarm, RandomLanes, Swarm, SwarmResult, SwarmSettings

Array = NDArray[np.float64]


def sphere(u: Array) -> Array:
    return np.sum(u**2, axis=-1)


def rosenbrock(u: Array) -> Array:
    return np.sum(100 * (u[..., 1:] - u[..., :-1] ** 2) ** 2 + (1 - u[..., :-1]) ** 2, axis=-1)


def rastrigin(u: Array) -> Array:
    return np.sum(u**2 - 10 * np.cos(2 * np.pi * u) + 10, axis=-1)


def search(
    objective: Callable[[Array], Array],
    lower: Array,
    upper: Array,
    settings: SwarmSettings,
    seed: int = 1,
    seeds: tuple[Array, ...] = (),
) -> SwarmResult:
    swarm = Swarm(lower, upper, settings, RandomLanes(seed), seeds)
    for _ in range(settings.iterations):
        swarm.tell(objective(swarm.ask()))
    return swarm.result()


@pytest.mark.parametrize(
    ("objective", "lower", "upper", "minimiser", "settings", "tolerance"),
    [
        (sphere, [-5.0] * 4, [3.0] * 4, [0.0] * 4, SwarmSettings(), 1e-6),
        (sphere, [0.5, -5.0], [3.0, -0.25], [0.5, -0.25], SwarmSettings(), 0.0),
        (
            rosenbrock, [-2.0] * 2, [2.0] * 2, [1.0] * 2,
            SwarmSettings(iterations=400, damping=0.8), 1e-3,
        ),
        (
            rosenbrock, [-2.0] * 4, [2.0] * 4, [1.0] * 4,
            SwarmSettings(particles=100, iterations=2000, damping=0.8), 1e-2,
        ),
        (
            rastrigin, [-5.0] * 2, [4.0] * 2, [0.0] * 2,
            SwarmSettings(particles=200, iterations=300, damping=0.8), 1e-6,
        ),
        (
            rastrigin, [0.6, -5.0], [4.0, 4.0], [0.9949586, 0.0],
            SwarmSettings(particles=200, iterations=300, damping=0.8), 1e-5,
        ),
    ],
    ids=[
        "sphere 4D", "sphere, minimum in a corner", "Rosenbrock 2D", "Rosenbrock 4D",
        "Rastrigin 2D", "Rastrigin, its global minimum outside the box",
    ],
)  # fmt: skip
def test_known_minima_are_found(
    objective: Callable[[Array], Array],
    lower: list[float],
    upper: list[float],
    minimiser: list[float],
    settings: SwarmSettings,
    tolerance: float,
) -> None:
    for seed in range(5):
        result = search(objective, np.array(lower), np.array(upper), settings, seed)
        assert np.abs(result.best - minimiser).max() <= tolerance
        assert result.cost == pytest.approx(float(objective(result.best)), abs=0)
        assert result.iterations == settings.iterations


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
    lanes = RandomLanes(2)
    swarm = QuadraticSwarm(settings, 4)
    misses = np.empty(searches)
    for i in range(searches):
        problem, minimiser = diagonal_problem(generator)
        off = np.abs(swarm.minimise(problem, lanes).best - minimiser)
        misses[i] = np.max(off / (problem.upper - problem.lower))
    return misses


@pytest.mark.parametrize("iterations", [60, 150])
def test_no_search_of_500_is_a_thousandth_of_the_range_off_the_closed_form(
    iterations: int,
) -> None:
    assert furthest_misses(SwarmSettings(iterations=iterations), 500).max() < 1e-3


def test_without_rebound_some_searches_stay_beside_a_minimum_on_the_bounds() -> None:
    misses = furthest_misses(SwarmSettings(rebound=0.0), 1000)
    assert 3 < np.sum(misses > 1e-3) < 50


def test_a_swarm_damped_to_0_3_freezes_away_from_the_minimum_however_small_its_spread() -> None:
    """Small epsilon is not quality: why lambda is 0.65 and why decisions carry a certificate."""
    generator = np.random.default_rng(3)
    lanes = RandomLanes(3)
    swarm = QuadraticSwarm(SwarmSettings(damping=0.3), 4)
    missed = 0
    for _ in range(100):
        problem, minimiser = diagonal_problem(generator)
        result = swarm.minimise(problem, lanes)
        assert result.spread < 1e-9
        off = np.abs(result.best - minimiser) / (problem.upper - problem.lower)
        missed += bool(off.max() > 1e-3)
    assert missed > 50


def test_an_undamped_swarm_does_not_contract() -> None:
    """Lambda = 1 is Eq. 19; the paper saw epsilon 1.3944, 0.94 to 2.00, in the box of Eq. 26."""
    bound = np.array([4.0, 0.2, 0.2, 0.1])
    problem = BoxQuadratic(np.eye(4), np.zeros(4), 0.0, -bound, bound)
    swarm = QuadraticSwarm(SwarmSettings(damping=1.0, rebound=0.0), 4)
    lanes = RandomLanes(4)
    spreads = [swarm.minimise(problem, lanes).spread for _ in range(50)]
    assert 1.2 < np.mean(spreads) < 1.6


def test_a_seed_repeats_a_search_and_the_stream_goes_on_until_it_is_reset() -> None:
    problem, _ = diagonal_problem(np.random.default_rng(5))
    swarm = QuadraticSwarm(SwarmSettings(iterations=5), 4)
    lanes, same, other = RandomLanes(5), RandomLanes(5), RandomLanes(6)
    first, second = (swarm.minimise(problem, lanes).best for _ in range(2))
    assert np.array_equal(swarm.minimise(problem, same).best, first)
    assert np.array_equal(swarm.minimise(problem, same).best, second)
    assert not np.array_equal(first, second)
    assert not np.array_equal(swarm.minimise(problem, other).best, first)
    lanes.reset()
    assert np.array_equal(swarm.minimise(problem, lanes).best, first)


def test_seed_particles_bound_the_answer_and_are_put_inside_the_box() -> None:
    minimiser = np.array([0.3, -0.4, 0.2, 0.1])
    problem = BoxQuadratic(np.eye(4), -minimiser, 0.0, -np.ones(4), np.ones(4))
    swarm = QuadraticSwarm(SwarmSettings(iterations=1), 4)
    unusable = np.full(4, np.nan)
    result = swarm.minimise(problem, RandomLanes(7), seeds=(unusable, minimiser))
    assert np.array_equal(result.best, minimiser)
    assert np.isfinite(result.spread)
    corner = BoxQuadratic(np.eye(4), -9 * np.ones(4), 0.0, -np.ones(4), np.ones(4))
    result = swarm.minimise(corner, RandomLanes(7), seeds=(9 * np.ones(4),))
    assert np.array_equal(result.best, np.ones(4))
    told = search(sphere, -np.ones(4), np.ones(4), SwarmSettings(iterations=1), 7, (np.zeros(4),))
    assert told.cost == 0.0


def test_a_fixed_dimension_stays_where_it_is() -> None:
    lower, upper = np.array([-1.0, 0.25, -1.0, -1.0]), np.array([1.0, 0.25, 1.0, 1.0])
    problem = BoxQuadratic(np.eye(4), np.zeros(4), 0.0, lower, upper)
    result = QuadraticSwarm(SwarmSettings(), 4).minimise(problem, RandomLanes(8))
    assert result.best == pytest.approx([0.0, 0.25, 0.0, 0.0], abs=1e-6)
    assert result.best[1] == 0.25


def test_costs_that_are_not_finite_are_counted_and_never_win() -> None:
    def holed(u: Array) -> Array:
        return np.where(u[:, 0] > 0, sphere(u - 0.5), np.array([np.nan, np.inf, -np.inf, 1e308])[
            np.arange(len(u)) % 4
        ])  # fmt: skip

    result = search(holed, -np.ones(2), np.ones(2), SwarmSettings())
    assert result.best == pytest.approx([0.5, 0.5], abs=1e-6)
    assert 10 < result.rejected < 40 * 150
    hopeless = search(lambda u: np.full(len(u), np.nan), -np.ones(2), np.ones(2), SwarmSettings())
    assert hopeless.cost == np.inf
    assert hopeless.rejected == 40 * 150
    assert np.all(np.abs(hopeless.best) <= 1)


def test_a_quadratic_that_is_not_finite_gives_a_point_of_the_box_at_infinite_cost() -> None:
    problem = BoxQuadratic(np.full((4, 4), np.nan), np.zeros(4), 0.0, -np.ones(4), np.ones(4))
    result = QuadraticSwarm(SwarmSettings(), 4).minimise(problem, RandomLanes(9))
    assert result.cost == np.inf
    assert np.all(np.abs(result.best) <= 1)


def test_the_answer_comes_when_the_time_is_up() -> None:
    problem, minimiser = diagonal_problem(np.random.default_rng(10))
    left = iter([0.002, 0.001, 0.0])
    swarm = QuadraticSwarm(SwarmSettings(iterations=1000), 4)
    result = swarm.minimise(problem, RandomLanes(10), remaining_s=lambda: next(left))
    assert result.cut_short
    assert result.iterations == 75
    assert np.abs(result.best - minimiser).max() < 1e-3
    unhurried = swarm.minimise(problem, RandomLanes(10), remaining_s=lambda: 1.0)
    assert not unhurried.cut_short
    assert unhurried.iterations == 1000


def test_time_up_at_the_last_iteration_cuts_nothing_short() -> None:
    problem, _ = diagonal_problem(np.random.default_rng(11))
    swarm = QuadraticSwarm(SwarmSettings(iterations=25), 4)
    assert not swarm.minimise(problem, RandomLanes(11), remaining_s=lambda: 0.0).cut_short


def test_a_spread_below_the_tolerance_ends_the_search() -> None:
    problem, minimiser = diagonal_problem(np.random.default_rng(12))
    settings = SwarmSettings(tolerance=1e-5, iterations=1000)
    result = QuadraticSwarm(settings, 4).minimise(problem, RandomLanes(12))
    assert result.spread <= 1e-5
    assert result.iterations < 200
    assert not result.cut_short
    assert np.abs(result.best - minimiser).max() < 1e-3
    swarm = Swarm(problem.lower, problem.upper, settings, RandomLanes(12))
    swarm.tell(problem(swarm.ask()))
    count = 1
    while swarm.spread > settings.tolerance:
        swarm.tell(problem(swarm.ask()))
        count += 1
    assert result.iterations - 25 < count <= result.iterations


def test_history_ends_where_the_answer_is() -> None:
    problem, _ = diagonal_problem(np.random.default_rng(13))
    swarm = QuadraticSwarm(SwarmSettings(), 4)
    plain = swarm.minimise(problem, RandomLanes(13))
    result = swarm.minimise(problem, RandomLanes(13), keep_history=True)
    assert plain.history is None
    assert result.history is not None
    assert result.history.positions.shape == (150, 40, 4)
    assert np.array_equal(result.best, plain.best)
    assert np.all(np.diff(result.history.costs) <= 0)
    assert result.history.costs[-1] == result.cost
    distance = np.linalg.norm(result.history.positions[-1] - result.best, axis=1)  # Eqs. 28-29
    assert result.spread == pytest.approx(distance.mean(), rel=1e-12)
    assert result.history.spreads[-1] == result.spread


@pytest.mark.parametrize(
    ("lower", "upper"),
    [([1.0], [0.0]), ([0.0, 0.0], [1.0]), ([-np.inf], [0.0]), ([np.nan], [0.0]), ([], [])],
)
def test_bounds_that_make_no_box_are_refused(lower: list[float], upper: list[float]) -> None:
    with pytest.raises(ValueError, match="bounds must be"):
        Swarm(lower, upper, SwarmSettings(), RandomLanes(0))


def test_misuse_of_ask_and_tell_is_refused() -> None:
    swarm = Swarm([-1.0], [1.0], SwarmSettings(particles=3), RandomLanes(0))
    assert np.array_equal(swarm.ask(), swarm.ask())
    with pytest.raises(ValueError, match="particles"):
        swarm.tell(np.zeros(4))
    swarm.tell(np.zeros(3))
    with pytest.raises(ValueError, match="tell without ask"):
        swarm.tell(np.zeros(3))


def test_a_problem_of_another_dimension_is_refused() -> None:
    problem = BoxQuadratic(np.eye(2), np.zeros(2), 0.0, -np.ones(2), np.ones(2))
    with pytest.raises(ValueError, match="2 inputs for a swarm of 4"):
        QuadraticSwarm(SwarmSettings(), 4).minimise(problem, RandomLanes(0))


@pytest.mark.parametrize(
    ("key", "value"), [("particles", 1), ("damping", 0.0), ("iterations", 0), ("inertia", np.nan)]
)
def test_settings_out_of_range_are_refused(key: str, value: float) -> None:
    with pytest.raises(ValidationError, match=key):
        SwarmSettings.model_validate({key: value})
