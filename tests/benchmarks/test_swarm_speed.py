"""What a search costs: run with `--benchmark-enable`. Nothing here asserts on time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from offboard.control.certificate import ExactMinimum, certify
from offboard.control.cost import BoxQuadratic
from offboard.control.swarm import QuadraticSwarm, RandomLanes, Swarm, SwarmSettings

LOWER = np.array([-4.0, -0.2, -0.2, -0.1])  # Eq. 26
UPPER = np.array([3.942, 0.2, 0.2, 0.1])
MINIMISER = np.array([1.0, -0.1, 0.05, 0.02])
HESSIAN = np.diag([1.1, 3.0, 3.0, 16.0]) + 0.1
PROBLEM = BoxQuadratic(HESSIAN, -HESSIAN @ MINIMISER, 20.0, LOWER, UPPER)


@pytest.mark.benchmark(group="one step, 4 inputs")
def test_compiled_swarm_40_by_150(benchmark: Any) -> None:
    swarm, lanes = QuadraticSwarm(SwarmSettings(), 4), RandomLanes(1)
    result = benchmark(swarm.minimise, PROBLEM, lanes)
    assert result.best == pytest.approx(MINIMISER, abs=1e-4)


@pytest.mark.benchmark(group="one step, 4 inputs")
def test_compiled_swarm_with_a_deadline(benchmark: Any) -> None:
    swarm, lanes = QuadraticSwarm(SwarmSettings(), 4), RandomLanes(1)
    result = benchmark(swarm.minimise, PROBLEM, lanes, (), lambda: 1.0)
    assert result.best == pytest.approx(MINIMISER, abs=1e-4)


@pytest.mark.benchmark(group="one step, 4 inputs")
def test_ask_tell_40_by_150(benchmark: Any) -> None:
    settings, lanes = SwarmSettings(), RandomLanes(1)

    def search() -> Any:
        swarm = Swarm(LOWER, UPPER, settings, lanes)
        for _ in range(settings.iterations):
            swarm.tell(PROBLEM(swarm.ask()))
        return swarm.result()

    assert benchmark(search).best == pytest.approx(MINIMISER, abs=1e-4)


@pytest.mark.benchmark(group="one step, 4 inputs")
def test_exact_minimum_by_daqp(benchmark: Any) -> None:
    exact = ExactMinimum(4)
    assert benchmark(exact.minimise, PROBLEM) == pytest.approx(MINIMISER, abs=1e-8)


@pytest.mark.benchmark(group="one step, 4 inputs")
def test_certificate(benchmark: Any) -> None:
    exact = ExactMinimum(4)
    result = QuadraticSwarm(SwarmSettings(), 4).minimise(PROBLEM, RandomLanes(1))
    assert benchmark(certify, PROBLEM, result, exact).gap < 1e-9
