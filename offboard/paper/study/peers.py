"""The swarm among its peers: the same problems, growing budgets, gap to the exact optimum.

The problems are met on the way of Figs. 5-6. pyswarms and CMA-ES come with the extra `peers` and
are listed as absent without it. An evaluation of J costs a Python call for everyone but the
compiled swarm and daqp: times are what a user of each would wait.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import logging
import os
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from offboard.control.certificate import ExactMinimum, certify
from offboard.control.cost import BoxQuadratic
from offboard.control.swarm import QuadraticSwarm, RandomLanes, SwarmResult, SwarmSettings
from offboard.flight.clock import monotonic_s
from offboard.paper.law import PaperLaw, PaperSettings
from offboard.paper.plant import paper_model
from offboard.paper.study.table import Column, Row, Table
from offboard.paper.trajectory import PathName, reach

Array = NDArray[np.float64]
Solver = Callable[[BoxQuadratic, int, int], Array]  # problem, evaluations, seed -> input (4,)

PARTICLES = 40
PAPER_EVALUATIONS = 40 * 150
BUDGETS = (80, 200, 400, 1000, 2000, PAPER_EVALUATIONS)
FEW_BUDGETS = (200, 1000, PAPER_EVALUATIONS)
GAP_SHOWN_FROM = 1e-17  # below is rounding; a logarithmic axis has no zero


@dataclass(frozen=True, slots=True)
class Heat:
    """One solver at one budget over all problems: median gap, 90th percentile, median time."""

    solver: str
    budget: int
    gap_median: float
    gap_p90: float
    time_s: float


def problems(count: int, settings: PaperSettings) -> list[BoxQuadratic]:
    """`count` problems spread over the path as the law meets them, on the linear plant."""
    way = reach(PathName.TOUR, 1000)
    law = PaperLaw(*paper_model(), settings)
    state, met = way.tracked[0], []
    for k in range(1000):
        move = law.move(state, way.tracked[k + 1])
        state = move.following
        met.append(move.problem)
    return [met[k] for k in np.linspace(20, 999, count).astype(int)]


def race(
    solver: str, settings: PaperSettings, count: int, budgets: Sequence[int] = BUDGETS
) -> list[Heat]:
    """`solver` at every budget (one heat, for a solver that takes none)."""
    course, solve = problems(count, settings), SOLVERS[solver]
    exact = ExactMinimum(4)
    heats = []
    with _quiet():
        for problem in course[:3]:
            solve(problem, budgets[0], 0)  # compile, import, warm caches
        for budget in budgets if solver not in DIRECT else (PAPER_EVALUATIONS,):
            gaps, times = [], []
            for seed, problem in enumerate(course):
                started = monotonic_s()
                found = solve(problem, budget, seed)
                times.append(monotonic_s() - started)
                gaps.append(_gap(problem, found, exact))
            median, p90 = np.quantile(gaps, [0.5, 0.9])
            heats.append(Heat(solver, budget, float(median), float(p90), float(np.median(times))))
    return heats


def absent() -> list[str]:
    """Solvers whose package is not installed."""
    return [name for name, package in _PACKAGES.items() if not importlib.util.find_spec(package)]


def present() -> list[str]:
    """Names of the solvers that are installed."""
    return [name for name in SOLVERS if name not in absent()]


def peers_table(heats: Sequence[Heat]) -> Table:
    """Gap to the exact optimum and time (ms) by solver and budget."""
    rows: list[Row] = [
        {
            "solver": heat.solver,
            "budget": None if heat.solver in DIRECT else heat.budget,
            "gap_median": heat.gap_median,
            "gap_p90": heat.gap_p90,
            "time_ms": 1e3 * heat.time_s,
        }
        for heat in heats
    ]
    rows += [{"solver": f"{name}: absent, install the extra `peers`"} for name in absent()]
    columns = (
        ("solver", "solver"), ("budget", "evaluations of J"), ("gap_median", "gap, median"),
        ("gap_p90", "gap, 90th percentile"), ("time_ms", "time, ms, median"),
    )  # fmt: skip
    notes = (
        "Four inputs, Eqs. 21 and 26. What uses the gradient or the matrices wins: this problem is "
        "a convex quadratic in a box. Solvers with a budget may stop before it.",
    )
    return Table("The swarm among its peers", [Column(*pair) for pair in columns], rows, notes)


def _gap(problem: BoxQuadratic, found: Array, exact: ExactMinimum) -> float:
    inside = np.clip(found, problem.lower, problem.upper)
    result = SwarmResult(inside, float(problem(inside)), float("nan"), 0)
    return max(certify(problem, result, exact).gap, GAP_SHOWN_FROM)


def _own(damping: float) -> Solver:
    def solve(problem: BoxQuadratic, evaluations: int, seed: int) -> Array:
        settings = SwarmSettings(
            particles=PARTICLES, iterations=max(evaluations // PARTICLES, 1), damping=damping
        )
        return QuadraticSwarm(settings, 4).minimise(problem, RandomLanes(seed)).best

    return solve


def _daqp(problem: BoxQuadratic, evaluations: int, seed: int) -> Array:
    return ExactMinimum(4).minimise(problem)


def _middle(problem: BoxQuadratic) -> Array:
    return 0.5 * (problem.lower + problem.upper)


def _bounds(problem: BoxQuadratic) -> optimize.Bounds:
    return optimize.Bounds(problem.lower, problem.upper)


def _minimize(method: str, option: str, **options: Any) -> Solver:
    def solve(problem: BoxQuadratic, evaluations: int, seed: int) -> Array:
        found = optimize.minimize(
            problem, _middle(problem), method=method, bounds=_bounds(problem),
            options={option: evaluations, **options},
        )  # fmt: skip
        return np.asarray(found.x)

    return solve


def _gradient(problem: BoxQuadratic, evaluations: int, seed: int) -> Array:
    found = optimize.minimize(
        problem, _middle(problem), jac=lambda u: problem.hessian @ u + problem.gradient,
        method="L-BFGS-B", bounds=_bounds(problem),
        options={"maxfun": evaluations, "ftol": 0.0, "gtol": 1e-12},
    )  # fmt: skip
    return np.asarray(found.x)


def _evolution(problem: BoxQuadratic, evaluations: int, seed: int) -> Array:
    found = optimize.differential_evolution(
        problem, _bounds(problem), popsize=PARTICLES // 4, polish=False, tol=0.0, rng=seed,
        maxiter=max(evaluations // PARTICLES - 1, 1),
    )  # fmt: skip
    return np.asarray(found.x)


def _annealing(problem: BoxQuadratic, evaluations: int, seed: int) -> Array:
    found = optimize.dual_annealing(problem, _bounds(problem), maxfun=evaluations, rng=seed)
    return np.asarray(found.x)


def _direct(problem: BoxQuadratic, evaluations: int, seed: int) -> Array:
    return np.asarray(optimize.direct(problem, _bounds(problem), maxfun=evaluations).x)


def _pyswarms(problem: BoxQuadratic, evaluations: int, seed: int) -> Array:
    with _no_log_file():
        import pyswarms

    np.random.seed(seed)  # noqa: NPY002  # pyswarms draws from nothing else
    weights = SwarmSettings()
    scale = weights.damping  # Eq. 30: lambda on all three terms
    with _no_log_file():
        swarm = pyswarms.single.GlobalBestPSO(
            PARTICLES, 4, bounds=(problem.lower, problem.upper),
            options={"w": scale * weights.inertia, "c1": scale * weights.personal,
                     "c2": scale * weights.social},
        )  # fmt: skip
    _, best = swarm.optimize(problem, max(evaluations // PARTICLES, 1), verbose=False)
    return np.asarray(best)


@contextlib.contextmanager
def _no_log_file() -> Iterator[None]:
    """pyswarms opens report.log in the working directory unless LOG_CFG names a configuration."""
    with tempfile.NamedTemporaryFile("w", suffix=".yaml") as nothing:
        nothing.write("{version: 1, disable_existing_loggers: false}")
        nothing.flush()
        os.environ["LOG_CFG"] = nothing.name
        try:
            yield
        finally:
            del os.environ["LOG_CFG"]


def _cma(problem: BoxQuadratic, evaluations: int, seed: int) -> Array:
    import cma

    width = problem.upper - problem.lower
    options = {
        "bounds": [problem.lower, problem.upper], "CMA_stds": width / 4, "maxfevals": evaluations,
        "seed": seed + 1, "verbose": -9, "tolfun": 0.0, "tolfunhist": 0.0, "tolx": 0.0,
    }  # fmt: skip
    found = cma.fmin2(problem, _middle(problem), 1.0, options)[1]
    best = found.result.xbest
    return np.asarray(_middle(problem) if best is None else best)


SOLVERS: dict[str, Solver] = {
    "this swarm, λ = 0.65": _own(0.65),
    "this swarm, λ = 1": _own(1.0),
    "daqp (exact QP)": _daqp,
    "pyswarms": _pyswarms,
    "CMA-ES": _cma,
    "SciPy differential evolution": _evolution,
    "SciPy dual annealing": _annealing,
    "SciPy DIRECT": _direct,
    "SciPy Nelder-Mead": _minimize("Nelder-Mead", "maxfev", xatol=1e-12, fatol=0.0),
    "SciPy Powell": _minimize("Powell", "maxfev", xtol=1e-12, ftol=0.0),
    "SciPy L-BFGS-B with gradient": _gradient,
}
DIRECT = frozenset({"daqp (exact QP)"})
_PACKAGES = {"pyswarms": "pyswarms", "CMA-ES": "cma"}


@contextlib.contextmanager
def _quiet() -> Any:
    """Without what the peers print and warn: budgets that run out are the point here."""
    logging.getLogger("pyswarms").setLevel(logging.CRITICAL)
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        yield
