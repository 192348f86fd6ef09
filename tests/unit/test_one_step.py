"""Eq. 21 as a quadratic against Eq. 21 as printed; the cost-to-go against what a flight costs."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from offboard.control.gains import riccati
from offboard.control.quadratic import BoxQuadratic
from offboard.paper.one_step import OneStep

Array = NDArray[np.float64]

GENERATOR = np.random.default_rng(21)
N, M = 5, 2
DYNAMICS = 0.6 * GENERATOR.normal(size=(N, N))
INPUTS = GENERATOR.normal(size=(N, M))
LIMIT = np.full(M, 1e3)


def weight(size: int) -> Array:
    root = GENERATOR.normal(size=(size, size))
    return root @ root.T + np.eye(size)


FITNESS, ENERGY, RATE = weight(N), weight(M), weight(M)


def unconstrained(problem: BoxQuadratic) -> Array:
    minimiser: Array = -np.linalg.solve(problem.hessian, problem.gradient)
    return minimiser


def test_the_quadratic_is_eq_21() -> None:
    step = OneStep(DYNAMICS, INPUTS, FITNESS, ENERGY, RATE)
    generator = np.random.default_rng(1)
    x, following = generator.normal(size=(2, N))
    nominal, previous = generator.normal(size=(2, M))
    given = (x, following, nominal, previous, -LIMIT, LIMIT)
    problem = step.problem(*given)
    bare = step.problem(*given, keep_constant=False)
    for u in generator.normal(size=(20, M)):
        e = following - (DYNAMICS @ x + INPUTS @ u)
        expected = (
            e @ FITNESS @ e
            + (nominal - u) @ ENERGY @ (nominal - u)
            + (u - previous) @ RATE @ (u - previous)
        )
        assert float(problem(u)) == pytest.approx(expected, rel=1e-12)
        assert float(bare(u)) == pytest.approx(expected - problem.constant, rel=1e-11)
    assert bare.constant == 0.0
    assert np.array_equal(problem.hessian, problem.hessian.T)


def test_predictions_broadcast_over_candidates() -> None:
    step = OneStep(DYNAMICS, INPUTS, FITNESS, ENERGY)
    generator = np.random.default_rng(2)
    x, inputs = generator.normal(size=N), generator.normal(size=(3, 4, M))
    predicted = step.predict(x, inputs)
    assert predicted.shape == (3, 4, N)
    assert predicted[2, 1] == pytest.approx(DYNAMICS @ x + INPUTS @ inputs[2, 1], rel=1e-14)


def test_one_step_with_the_cost_to_go_pays_what_the_cost_to_go_says() -> None:
    """The law flown for long from x costs x'Px, and no gain near it costs less."""
    terminal = riccati(DYNAMICS, INPUTS, FITNESS, ENERGY)
    step = OneStep(DYNAMICS, INPUTS, terminal, ENERGY)
    zero = np.zeros(M)
    start = np.random.default_rng(3).normal(size=N)

    def flown(change: Array) -> float:
        x, paid = start, 0.0
        for _ in range(500):
            problem = step.problem(x, np.zeros(N), zero, zero, -LIMIT, LIMIT)
            u = unconstrained(problem) + change @ x
            paid += x @ FITNESS @ x + u @ ENERGY @ u
            x = DYNAMICS @ x + INPUTS @ u
        return float(paid)

    best = flown(np.zeros((M, N)))
    assert best == pytest.approx(start @ terminal @ start, rel=1e-9)
    for change in 0.01 * np.random.default_rng(4).normal(size=(10, M, N)):
        assert flown(change) > best


def test_one_step_with_the_cost_to_go_is_the_lqr() -> None:
    terminal = riccati(DYNAMICS, INPUTS, FITNESS, ENERGY)
    left = np.zeros((N, N))  # the least cost of the last 500 steps, by dynamic programming
    for _ in range(500):
        gain = np.linalg.solve(ENERGY + INPUTS.T @ left @ INPUTS, INPUTS.T @ left @ DYNAMICS)
        left = FITNESS + DYNAMICS.T @ left @ (DYNAMICS - INPUTS @ gain)
    step = OneStep(DYNAMICS, INPUTS, terminal, ENERGY)
    x, reference, nominal = np.random.default_rng(5).normal(size=(3, N))
    problem = step.problem(x, np.zeros(N), np.zeros(M), np.zeros(M), -LIMIT, LIMIT)
    assert unconstrained(problem) == pytest.approx(-gain @ x, rel=1e-9)
    moving = DYNAMICS @ reference + INPUTS @ nominal[:M]  # a reference that obeys the model
    problem = step.problem(x, moving, nominal[:M], np.zeros(M), -LIMIT, LIMIT)
    expected = nominal[:M] - gain @ (x - reference)
    assert unconstrained(problem) == pytest.approx(expected, rel=1e-9)


def test_no_cost_to_go_where_no_input_reaches_an_unstable_state() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        riccati(np.diag([1.1, 0.5]), [[0.0], [1.0]], np.eye(2), np.eye(1))
