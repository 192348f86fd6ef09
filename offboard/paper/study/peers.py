"""The swarm compared with other optimisers: the same problems, growing budgets, gap to the optimum.

The problems are those that the law solves on the path of Figs. 5-6. pyswarms and CMA-ES come with
the extra `peers` and are listed as absent without it. An evaluation of J is a Python call for all
but the compiled swarm and daqp: times are what a user of each would wait.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import logging
import os
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from offboard.analysis.figure import PALETTE, Figure, curve, panels
from offboard.control.certificate import ExactMinimum, certify
from offboard.control.cost import BoxQuadratic
from offboard.control.swarm import QuadraticSwarm, RandomLanes, SwarmResult, SwarmSettings
from offboard.io.clock import monotonic_s
from offboard.paper.law import PaperLaw, PaperSettings
from offboard.paper.plant import paper_model
from offboard.paper.study.page import Row, Table
from offboard.paper.trajectory import PathName, sampled_path

Array = NDArray[np.float64]
Solver = Callable[[BoxQuadratic, int, int], Array]  # problem, evaluations, seed -> input (4,)

PARTICLES = 40
PAPER_EVALUATIONS = 40 * 150
BUDGETS = (80, 200, 400, 1000, 2000, PAPER_EVALUATIONS)
FEW_BUDGETS = (200, 1000, PAPER_EVALUATIONS)
LEAST_GAP = 1e-17  # shown for smaller gaps: they are rounding, and a logarithmic axis has no zero


@dataclass(frozen=True, slots=True)
class Measurement:
    """A solver at one budget, over all problems."""

    budget: int
    gap_median: float
    gap_p90: float
    time_s: float  # median


Measured = Mapping[str, Sequence[Measurement]]  # by solver


def problems(count: int, settings: PaperSettings) -> list[BoxQuadratic]:
    """`count` problems spread over the path of Figs. 5-6, flown on the linear plant."""
    path = sampled_path(PathName.TOUR, 1000)
    law = PaperLaw(*paper_model(), settings)
    state, solved = path.tracked[0], []
    for k in range(1000):
        move = law.move(state, path.tracked[k + 1])
        state = move.following
        solved.append(move.problem)
    return [solved[k] for k in np.linspace(20, 999, count).astype(int)]


def measure(
    solver: str, settings: PaperSettings, count: int, budgets: Sequence[int] = BUDGETS
) -> list[Measurement]:
    """`solver` on `count` problems at every budget; once, for a solver without a budget."""
    posed, solve = problems(count, settings), SOLVERS[solver]
    exact = ExactMinimum(4)
    measured = []
    with _quiet():
        for problem in posed[:3]:
            solve(problem, budgets[0], 0)  # compile, import
        for budget in budgets if solver not in DIRECT else (PAPER_EVALUATIONS,):
            gaps, times_s = [], []
            for seed, problem in enumerate(posed):
                started = monotonic_s()
                found = solve(problem, budget, seed)
                times_s.append(monotonic_s() - started)
                gaps.append(_gap(problem, found, exact))
            median, p90 = np.quantile(gaps, [0.5, 0.9])
            time_s = float(np.median(times_s))
            measured.append(Measurement(budget, float(median), float(p90), time_s))
    return measured


def absent() -> list[str]:
    """Solvers whose package is not installed."""
    return [name for name, package in _PACKAGES.items() if not importlib.util.find_spec(package)]


def present() -> list[str]:
    """Solvers that are installed."""
    return [name for name in SOLVERS if name not in absent()]


def peers_table(measured: Measured) -> Table:
    """Gap to the exact optimum and time by solver and budget."""
    rows: list[Row] = [
        {
            "solver": name,
            "budget": None if name in DIRECT else each.budget,
            "gap_median": each.gap_median,
            "gap_p90": each.gap_p90,
            "time_ms": 1e3 * each.time_s,
        }
        for name, own in measured.items()
        for each in own
    ]
    rows += [{"solver": f"{name}: absent, install the extra `peers`"} for name in absent()]
    columns = {
        "solver": "solver", "budget": "evaluations of J", "gap_median": "gap, median",
        "gap_p90": "gap, 90th percentile", "time_ms": "time, ms, median",
    }  # fmt: skip
    notes = (
        "Four inputs, Eqs. 21 and 26. Solvers that use the gradient or the matrices are best: the "
        "problem is a convex quadratic in a box. Solvers with a budget may stop before it.",
    )
    return Table("The swarm and other optimisers", columns, rows, notes)


def peers_figure(measured: Measured) -> Figure:
    """Gap over time: one curve per solver, one point per budget."""
    drawing = panels(("gap to J*, median",), "time for one solve, ms", panel_px=380)
    for i, (name, own) in enumerate(measured.items()):
        direct = name in DIRECT
        curve(
            drawing, 1, [1e3 * each.time_s for each in own], [each.gap_median for each in own],
            name, PALETTE[i % len(PALETTE)], mode="markers" if direct else "lines+markers",
            text=[f"{each.budget} evaluations" for each in own],
            line={"width": 3 if "this" in name else 1.4},
            marker={"size": 8, "symbol": "star" if direct else "circle"},
        )  # fmt: skip
    drawing.update_xaxes(type="log", dtick=1).update_yaxes(type="log")
    budgets = sorted({each.budget for own in measured.values() for each in own})
    caption = (
        f"Points: {', '.join(map(str, budgets))} evaluations of J. Lower left is better; gaps "
        "below 1e-17 are drawn as 1e-17."
    )
    return Figure("The swarm and other optimisers", drawing, caption)


def _gap(problem: BoxQuadratic, found: Array, exact: ExactMinimum) -> float:
    inside = np.clip(found, problem.lower, problem.upper)
    result = SwarmResult(inside, float(problem(inside)), float("nan"), 0)
    return max(certify(problem, result, exact).gap, LEAST_GAP)


def _own(damping: float) -> Solver:
    def solve(problem: BoxQuadratic, evaluations: int, seed: int) -> Array:
        iterations = max(evaluations // PARTICLES, 1)
        settings = SwarmSettings(particles=PARTICLES, iterations=iterations, damping=damping)
        return QuadraticSwarm(settings, 4).minimise(problem, RandomLanes(seed)).best

    return solve


def _daqp(problem: BoxQuadratic, evaluations: int, seed: int) -> Array:
    return ExactMinimum(4).minimise(problem)


def _middle(problem: BoxQuadratic) -> Array:
    return 0.5 * (problem.lower + problem.upper)


def _scipy(minimiser: Callable[..., Any], budget: str, seeded: bool = True) -> Solver:
    """A global optimiser of SciPy; `budget` is its argument for the number of evaluations."""

    def solve(problem: BoxQuadratic, evaluations: int, seed: int) -> Array:
        options = {budget: evaluations, **({"rng": seed} if seeded else {})}
        bounds = optimize.Bounds(problem.lower, problem.upper)
        return np.asarray(minimiser(problem, bounds, **options).x)

    return solve


def _minimize(method: str, budget: str, gradient: bool = False, **options: Any) -> Solver:
    """A local optimiser of SciPy, from the middle of the box."""

    def solve(problem: BoxQuadratic, evaluations: int, seed: int) -> Array:
        slope = (lambda u: problem.hessian @ u + problem.gradient) if gradient else None
        found = optimize.minimize(
            problem, _middle(problem), method=method, jac=slope,
            bounds=optimize.Bounds(problem.lower, problem.upper),
            options={budget: evaluations, **options},
        )  # fmt: skip
        return np.asarray(found.x)

    return solve


def _evolve(problem: BoxQuadratic, bounds: optimize.Bounds, evaluations: int, rng: int) -> Any:
    return optimize.differential_evolution(
        problem, bounds, popsize=PARTICLES // 4, polish=False, tol=0.0, rng=rng,
        maxiter=max(evaluations // PARTICLES - 1, 1),
    )  # fmt: skip


def _pyswarms(problem: BoxQuadratic, evaluations: int, seed: int) -> Array:
    weights = SwarmSettings()
    scale = weights.damping  # Eq. 30: lambda on all three terms
    options = {
        "w": scale * weights.inertia, "c1": scale * weights.personal, "c2": scale * weights.social,
    }  # fmt: skip
    np.random.seed(seed)  # noqa: NPY002  # pyswarms has no other source of randomness
    with _no_log_file():
        import pyswarms

        swarm = pyswarms.single.GlobalBestPSO(
            PARTICLES, 4, bounds=(problem.lower, problem.upper), options=options
        )
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
    "SciPy differential evolution": _scipy(_evolve, "evaluations"),
    "SciPy dual annealing": _scipy(optimize.dual_annealing, "maxfun"),
    "SciPy DIRECT": _scipy(optimize.direct, "maxfun", seeded=False),
    "SciPy Nelder-Mead": _minimize("Nelder-Mead", "maxfev", xatol=1e-12, fatol=0.0),
    "SciPy Powell": _minimize("Powell", "maxfev", xtol=1e-12, ftol=0.0),
    "SciPy L-BFGS-B with gradient": _minimize("L-BFGS-B", "maxfun", True, ftol=0.0, gtol=1e-12),
}
DIRECT = frozenset({"daqp (exact QP)"})  # solvers without a budget
_PACKAGES = {"pyswarms": "pyswarms", "CMA-ES": "cma"}


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without the output and warnings of solvers whose budget ends, which is intended here."""
    logging.getLogger("pyswarms").setLevel(logging.CRITICAL)
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        yield
