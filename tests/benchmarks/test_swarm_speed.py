"""What a search costs: run with `--benchmark-enable`. Nothing here asserts on time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from offboard.control.quadratic import BoxQuadratic, ExactMinimum
from offboard.control.swarm import Swarm, SwarmSettings, certify, minimise

pytestmark = pytest.mark.slow
LOWER = np.array([-4.0, -0.2, -0.2, -0.1])  # Eq. 26
UPPER = np.array([3.942, 0.2, 0.2, 0.1])
MINIMISER = np.array([1.0, -0.1, 0.05, 0.02])
HESSIAN = np.diag([1.1, 3.0, 3.0, 16.0]) + 0.1
PROBLEM = BoxQuadratic(HESSIAN, -HESSIAN @ MINIMISER, 20.0, LOWER, UPPER)


@pytest.mark.benchmark(group="one step, 4 inputs")
@pytest.mark.parametrize("remaining_s", [None, lambda: 1.0], ids=["", "with a deadline"])
def test_compiled_swarm_40_by_150(benchmark: Any, remaining_s: Any) -> None:
    result = benchmark(minimise, SwarmSettings(), PROBLEM, np.random.default_rng(1), remaining_s)
    assert result.best == pytest.approx(MINIMISER, abs=1e-4)


@pytest.mark.benchmark(group="one step, 4 inputs")
def test_ask_tell_40_by_150(benchmark: Any) -> None:
    settings, rng = SwarmSettings(), np.random.default_rng(1)

    def search() -> Any:
        swarm = Swarm(settings, LOWER, UPPER, rng)
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
    result = minimise(SwarmSettings(), PROBLEM, np.random.default_rng(1))
    assert benchmark(certify, PROBLEM, result, exact).gap < 1e-9
