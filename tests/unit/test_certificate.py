"""The certificate against an oracle of its own: all 81 active sets of a box in four dimensions."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from offboard.control.quadratic import BoxQuadratic, ExactMinimum, at_bound
from offboard.control.swarm import SwarmResult, SwarmSettings, certify, minimise

Array = NDArray[np.float64]


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


def test_the_exact_minimum_is_that_of_all_active_sets() -> None:
    generator = np.random.default_rng(1)
    exact = ExactMinimum(4)
    active = set()
    for _ in range(150):
        problem = coupled_problem(generator)
        minimiser, _ = enumerated_minimum(problem)
        found = exact.minimise(problem)
        assert found == pytest.approx(minimiser, abs=1e-8)
        assert 0 <= certify(problem, answer(problem, minimiser), exact).gap < 1e-12
        active.add(int(np.sum((found == problem.lower) | (found == problem.upper))))
    assert active == {0, 1, 2, 3, 4}


def test_the_gap_is_how_much_more_the_answer_costs() -> None:
    generator = np.random.default_rng(2)
    exact = ExactMinimum(4)
    for _ in range(100):
        problem = coupled_problem(generator, constant=1000.0)
        _, optimal = enumerated_minimum(problem)
        inputs = generator.uniform(problem.lower, problem.upper)
        certificate = certify(problem, answer(problem, inputs), exact)
        cost = float(problem(inputs))
        assert certificate.cost == cost
        assert certificate.optimal_cost == pytest.approx(optimal, rel=1e-9)
        assert certificate.gap == pytest.approx((cost - optimal) / abs(optimal), rel=1e-6, abs=1e-9)
        assert (certificate.spread, certificate.iterations) == (0.25, 150)
        assert certificate.cut_short


def test_the_gap_is_resolved_below_the_rounding_of_the_costs() -> None:
    """1e-6 off the minimum in each input costs 2e-12; beside 1e6, J cannot show it."""
    problem = BoxQuadratic(np.eye(4), np.zeros(4), 1e6, -np.ones(4), np.ones(4))
    inputs = np.full(4, 1e-6)
    assert float(problem(inputs)) == 1e6
    certificate = certify(problem, answer(problem, inputs))
    assert certificate.gap == pytest.approx(2e-18, rel=1e-6)


def test_the_gap_stays_meaningful_where_the_minimum_costs_nothing() -> None:
    problem = BoxQuadratic(np.eye(4), np.zeros(4), 0.0, -np.ones(4), np.ones(4))
    result = minimise(SwarmSettings(), problem, np.random.default_rng(4))
    assert certify(problem, result).gap < 1e-9
    half = certify(problem, answer(problem, np.full(4, 0.5)))
    assert half.optimal_cost == 0.0
    assert half.gap > 1000
    flat = BoxQuadratic(np.zeros((4, 4)), np.zeros(4), 0.0, -np.ones(4), np.ones(4))
    assert certify(flat, answer(flat, np.zeros(4))).gap == 0.0


def test_at_bound_looks_at_the_inputs_that_can_move() -> None:
    lower, upper = np.array([-1.0, 0.5, -1.0]), np.array([1.0, 0.5, 1.0])
    problem = BoxQuadratic(np.eye(3), np.zeros(3), 0.0, lower, upper)
    assert not at_bound(problem, np.array([0.0, 0.5, 0.999]))
    assert at_bound(problem, np.array([0.0, 0.5, 1.0]))
    assert at_bound(problem, np.array([-1.0, 0.5, 0.0]))
    assert certify(problem, answer(problem, np.array([-1.0, 0.5, 0.0]))).at_bound


def test_a_problem_that_is_not_finite_has_no_certificate_and_spoils_no_later_one() -> None:
    exact = ExactMinimum(4)
    sound = BoxQuadratic(np.eye(4), np.full(4, 0.5), 0.0, -np.ones(4), np.ones(4))
    spoilt = BoxQuadratic(np.full((4, 4), np.nan), np.zeros(4), 0.0, sound.lower, sound.upper)
    certificate = certify(spoilt, answer(spoilt, np.zeros(4)), exact)
    assert np.isnan(certificate.gap)
    assert np.isnan(certificate.optimal_cost)
    steep = BoxQuadratic(np.eye(4), np.array([np.nan, 0, 0, 0]), 0.0, sound.lower, sound.upper)
    assert np.isnan(exact.minimise(steep)).all()
    assert exact.minimise(sound) == pytest.approx(np.full(4, -0.5), abs=1e-9)
