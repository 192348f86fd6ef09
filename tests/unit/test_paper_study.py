"""The study of the paper: printed numbers, independent oracles, and the page without a network."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import control
import numpy as np
import pytest
from browser import opening
from numpy.typing import NDArray
from rich.console import Console
from scipy.linalg import solve_discrete_are

from offboard.analysis.page import Figure
from offboard.control.swarm import certify
from offboard.documents.errors import UserError
from offboard.paper import closed_loop, extensions, tables
from offboard.paper.closed_loop import (
    Flight,
    Flights,
    FlightTask,
    PlantKind,
    damped,
    fly,
    linear_plant,
    nonlinear_plant,
    paper_model,
)
from offboard.paper.controller import paper_vehicle
from offboard.paper.extensions import receding
from offboard.paper.law import LimitedBox, PaperLaw, PaperSettings, StateLimits
from offboard.paper.study import MAKERS, PAGE, reproduce

Array = NDArray[np.float64]

FINAL = PaperSettings()
Q, R, RATE = (np.diag(part) for part in (FINAL.fitness, FINAL.energy, FINAL.rate))
BOX = np.array(FINAL.lower), np.array(FINAL.upper)
TIGHT = StateLimits(
    tilt_rad=0.2, tilt_rate_radps=0.3, yaw_rate_radps=0.5, speed_mps=1.2, climb_mps=0.4
)
FLIGHTS = Flights(seeds=2)


@cache
def flown(damping: float, keep_constant: bool = True) -> list[Flight]:
    settings = damped(damping).model_copy(update={"keep_constant": keep_constant})
    return FLIGHTS.by_seed(settings)


def mean_spread(flights: list[Flight]) -> float:
    return float(np.mean([flight.spreads for flight in flights]))


# ---------------------------------------------------------------- the law and its model


def test_cost_agrees_with_eq_21() -> None:
    """The quadratic that the swarm gets equals Eq. 21 as printed; a reset forgets u(k-1)."""
    a, b = paper_model()
    rng = np.random.default_rng(1)
    for keep_constant in (True, False):
        law = PaperLaw(a, b, FINAL.model_copy(update={"keep_constant": keep_constant}))
        applied = law.move(0.1 * rng.normal(size=12), np.zeros(12)).inputs
        for previous in (applied, np.zeros(4)):
            x, target = rng.normal(size=12), rng.normal(size=12)
            problem = law.move(x, target).problem
            law.reset()

            def eq_21(u: Array) -> float:
                e = target - (a @ x + b @ u)  # noqa: B023
                change = u - previous  # noqa: B023
                return float(e @ Q @ e + u @ R @ u + change @ RATE @ change)

            lost = 0.0 if keep_constant else eq_21(np.zeros(4))
            for u in rng.normal(size=(20, 4)):
                assert float(problem(u)) == pytest.approx(eq_21(u) - lost, rel=1e-10)


def test_one_step_with_cost_to_go_is_the_lqr() -> None:
    a, b = paper_model()
    gain, _, poles = control.dlqr(a, b, Q, R)
    free = FINAL.model_copy(update={"rate": (0,) * 4, "lower": (-1e3,) * 4, "upper": (1e3,) * 4})
    law = PaperLaw(a, b, free, terminal=closed_loop.cost_to_go(free))
    x = 0.1 * np.random.default_rng(5).normal(size=12)
    problem = law.move(x, np.zeros(12)).problem
    best = -np.linalg.solve(problem.hessian, problem.gradient)
    assert best == pytest.approx(-gain @ x, rel=1e-9)
    p = solve_discrete_are(a, b, Q, R)
    found = receding(a, b, Q, R, 0 * RATE, 1, p)
    np.testing.assert_allclose(np.abs(found)[:12], np.sort(np.abs(poles))[::-1], rtol=1e-6)


def test_longer_horizons_shorten_the_time_constant() -> None:
    """The poles of 300 steps are those of the infinite horizon."""
    for steps, time_constant_s in ((1, 39.16), (5, 5.46), (10, 1.69), (20, 1.07)):
        slowest = abs(receding(*paper_model(), Q, R, RATE, steps)[0])
        assert -0.1 / math.log(slowest) == pytest.approx(time_constant_s, rel=5e-3)
    long, endless = receding(*paper_model(), Q, R, RATE, 300), receding(*paper_model(), Q, R, RATE)
    np.testing.assert_allclose(np.abs(long)[:6], np.abs(endless)[:6], rtol=1e-4)


@pytest.mark.parametrize("plant", PlantKind)
def test_cost_to_go_settles_a_hundred_times_closer(plant: PlantKind) -> None:
    """A hover that begins 1 m off is compared after 20 s; time constants are 39 s and about 1 s."""
    task = FlightTask(PaperSettings(), plant, hover=True, start_offset_m=(1.0, 0.0, 0.0), steps=200)
    one, best = (
        fly(replace(task, cost_to_go=cost_to_go)).position_errors_m[-1]
        for cost_to_go in (False, True)
    )
    assert one > 0.5
    assert best < 0.01 * one


def test_linear_and_nonlinear_plants_settle_alike() -> None:
    """A level vehicle reaches the wind's velocity; with 10 % less thrust it sinks by its drag."""
    vehicle = paper_vehicle()
    sink = 0.1 * vehicle.mass_kg * vehicle.gravity_mps2 / vehicle.drag_translation_npmps[2]
    wind = np.array([1.5, -0.5, 0.2])
    for plant in (linear_plant, nonlinear_plant):
        blows, weakens = plant(wind, 0.0), plant(np.zeros(3), 0.1)
        blown, weak = np.zeros(12), np.zeros(12)
        for _ in range(200):
            blown, weak = blows(blown, np.zeros(4)), weakens(weak, np.zeros(4))
        np.testing.assert_allclose(blown[6:9], wind, atol=1e-6)
        assert weak[8] == pytest.approx(sink, rel=1e-6)


# ---------------------------------------------------------------- the printed tables


def test_undamped_epsilon_matches_paper_and_damping_halves_costs() -> None:
    loud, quiet = flown(1.0), flown(0.65)
    assert 0.9 < mean_spread(loud) < 1.7  # printed 1.3944
    assert min(flight.spreads.min() for flight in loud) > 0.5  # printed 0.9380
    assert max(flight.spreads.max() for flight in loud) < 3.0  # printed 2.0023
    costs = [np.mean([flight.signal_costs.sum() for flight in each]) for each in (loud, quiet)]
    assert costs[1] < 0.5 * costs[0]


@pytest.mark.slow
def test_damped_epsilon_matches_the_paper_only_with_the_constant_term() -> None:
    kept, dropped = mean_spread(flown(0.65)), mean_spread(flown(0.65, keep_constant=False))
    assert 2.77e-9 < kept < 2.77e-7  # printed 2.7744e-08
    assert dropped < 0.03 * kept


def test_swarm_reaches_the_optimum_only_at_the_best_damping() -> None:
    missed = {
        d: float(np.mean([flight.gaps > 1e-6 for flight in flown(d)])) for d in (0.3, 0.65, 1.0)
    }
    assert np.median([flight.gaps for flight in flown(0.65)]) <= 1e-9
    assert missed[0.65] == 0.0
    assert missed[0.3] > 0.2
    assert missed[1.0] > 0.4
    assert mean_spread(flown(0.3)) < 1e-2 * mean_spread(flown(0.65))  # small, but it is missed


def test_reweighting_removes_95_percent_of_the_error() -> None:
    before = np.mean([flight.errors[-1] for flight in flown(0.65)])
    after = np.mean([flight.errors[-1] for flight in FLIGHTS.by_seed(FINAL)])
    assert after < 0.05 * before  # printed ratio 0.0163
    assert 1e6 < before < 3e7  # printed 5.3519e6


# ---------------------------------------------------------------- integral term, state limits


@pytest.mark.slow
def test_integral_removes_the_steady_error() -> None:
    for row in extensions.integral_table(FLIGHTS).rows:
        if row["law"] == "integral":
            assert row["steady position error, m"] < 1e-3, row
        else:  # with the weights alone it stays
            assert row["steady position error, m"] > 0.1, row


@pytest.mark.slow
def test_state_limits_hold_in_every_sample_of_the_path() -> None:
    for row in extensions.limits_table(FLIGHTS).rows:
        if row["law"] == "limited":
            assert row["greatest"] <= row["limit"] * (1 + 1e-9), row
        if row["state"] in ("tilt_rad", "speed_mps"):
            free = row["law"] == "free"
            assert row["greatest"] > (1.2 if free else 0.8) * row["limit"], row


def test_vehicle_returns_within_its_state_limits_and_stays() -> None:
    """The vehicle begins at twice its speed limit and brakes. Then its inputs are a random corner
    of the narrowed box, drawn every 7 steps, up to 3000 steps."""
    dynamics, inputs = paper_model()
    box = LimitedBox(dynamics, inputs, TIGHT, *BOX)
    rng = np.random.default_rng(1)
    state, corner, greatest = np.zeros(12), np.zeros(4), np.zeros(12)
    state[6] = 2.0 * TIGHT.speed_mps
    for k in range(3000):
        if k >= 60 and k % 7 == 0:
            corner = rng.choice([0.0, 1.0], 4)
        lower, upper = box.narrow(state)
        assert k < 60 or (lower <= upper).all()
        state = dynamics @ state + inputs @ (lower + corner * (upper - lower))
        greatest = np.maximum(greatest, np.abs(state)) if k >= 60 else greatest
    for index, limit in TIGHT.per_state().items():
        assert greatest[index] <= limit * (1 + 1e-9)
        assert greatest[index] > 0.9 * limit


def test_certificate_holds_for_the_narrowed_box() -> None:
    settings = PaperSettings(limits=TIGHT)
    law = PaperLaw(*paper_model(), settings)
    target = np.zeros(12)
    target[9:] = 50.0
    state = np.zeros(12)
    for _ in range(40):
        move = law.move(state, target)
        certificate = certify(move.problem, move.result)
        assert certificate.gap <= 1e-9
        state = move.following
    assert certificate.at_bound
    assert abs(state[6]) <= TIGHT.speed_mps * (1 + 1e-9)


def test_coupled_axes_are_refused() -> None:
    dynamics, inputs = (matrix.copy() for matrix in paper_model())
    inputs[3, 2] = 0.1
    with pytest.raises(ValueError, match="axes that do not couple"):
        LimitedBox(dynamics, inputs, TIGHT, *BOX)


# ---------------------------------------------------------------- the run and its page


Run = tuple[Path, dict[str, tables.Table | Figure]]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Directory and contents of a whole study, with flights of 5 s."""
    out = tmp_path_factory.mktemp("paper")
    with pytest.MonkeyPatch.context() as short:
        short.setattr(closed_loop, "fly", lambda task: fly(replace(task, steps=50)))
        return out, reproduce(out, [], 1, Console(file=io.StringIO()))


# [name, whether plotly has drawn it, traces, height] of each figure
DRAWN = """[...document.querySelectorAll('.figure')].map(f => [f.id.replace('figure_', ''),
  !!f.querySelector('.main-svg'),
  f.querySelectorAll('.scatterlayer .trace path, .scatterlayer .trace').length
  + f.querySelectorAll('.gl-container canvas').length, f.clientHeight])"""


@pytest.mark.slow
def test_study_page_opens_offline_and_shows_everything(run: Run) -> None:
    out, made = run
    assert set(made) == set(MAKERS)
    with opening(out / PAGE) as opened:
        drawn = opened.page.evaluate(DRAWN)
        assert opened.fetched == []
        for scheme in ("dark", "light"):
            opened.switch(scheme)
            assert opened.unreadable() == []
        opened.resize(400)
        assert opened.width_px() == 400
        assert opened.colliding() == []
        shown = opened.page.evaluate(
            "[...document.querySelectorAll('article[id^=table]')]"
            ".map(a => [a.id.replace('_', ' '), a.querySelectorAll('tr').length - 1])"
        )
        assert opened.problems == []
    assert {f"figure {name}" for name, *_ in drawn} | {name for name, _ in shown} == set(MAKERS)
    for name, svg, marks, height in drawn:
        assert svg and marks > 0 and height > 300, name  # noqa: PT018
    for name, count in shown:
        table = made[name]
        assert isinstance(table, tables.Table)
        assert count == len(table.rows)


def test_unknown_figure_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="there is no figure '3'; known are 4, 5"):
        reproduce(tmp_path / "never", ["figure 3"], 1, Console(file=io.StringIO()))
    assert not (tmp_path / "never").exists()
