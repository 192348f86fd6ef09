"""Plans over N decisions: quadratic cost, roll-outs against SciPy, and what the searches find."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from attitude_plant import lemniscate
from laws import LEVEL, PX4, G, at, lqr, on_target, state_of
from scipy.integrate import solve_ivp

from offboard.control.base import Situation
from offboard.control.horizon import STEPS_AROUND, HorizonLaw, HorizonSettings, Plan
from offboard.control.mpc import MpcLaw, MpcSettings
from offboard.control.roll_out import STATE_SIZE, B, P, T, V, W, Z
from offboard.model.command import PredictedState
from offboard.reference.track import hold

STEPS, PERIOD_S = 10, 0.1
IN_THE_WAY = {"shape": "sphere", "north_m": 0.6, "east_m": -0.7, "height_m": 3.0, "radius_m": 0.3}
PASSING = IN_THE_WAY | {"east_m": -1.4, "velocity_east_mps": 1.4}


def horizon(**settings: object) -> HorizonLaw:
    return HorizonLaw(PX4, HorizonSettings.model_validate({"bandwidth_radps": 5.0} | settings))


def situations(count: int, size: float, seed: int = 1) -> list[Situation]:
    rng, reference = np.random.default_rng(seed), lemniscate(8.0)
    return [Situation(5.0, state_of(rng, reference, size), reference, LEVEL) for _ in range(count)]


def about_hover(count: int, size: float) -> list[Situation]:
    """States near a level hover, where the nonlinear motion is linear to first order."""
    rng, reference = np.random.default_rng(4), hold((0.0, 0.0, -3.0), 0.0)
    found = []
    for _ in range(count):
        tilt = 0.1 * size * rng.normal(size=2)
        state = replace(
            at(np.array([0.0, 0.0, -3.0]) + size * rng.normal(size=3), 0.0),
            time_s=5.057,
            velocity_ned_mps=size * rng.normal(size=3),
            thrust_direction_ned=np.array([*tilt, math.sqrt(1.0 - tilt @ tilt)]),
            thrust_direction_rate_ned_ps=np.array([*(0.2 * size * rng.normal(size=2)), 0.0]),
            thrust_mps2=G + 0.3 * size * rng.normal(),
        )
        found.append(Situation(5.0, state, reference, LEVEL))
    return found


def left_to_pay(law: HorizonLaw, situation: Situation) -> float:
    """x'Px: the cost to go of the closed form, which has no bounds."""
    now = law.problem(situation)
    left = np.sum(now.at_hover * (law.lateral.terminal @ now.at_hover))
    return float(left + now.vertical @ law.vertical.terminal @ now.vertical)


def closed_form(law: HorizonLaw) -> Plan:
    steps = law.quadratic.steps
    return law.fly(np.zeros((steps, 3)), np.zeros((steps + 1, STATE_SIZE)))[0]


def test_quadratic_rollout_and_closed_form_costs_agree_near_hover() -> None:
    law, rng = horizon(), np.random.default_rng(2)
    for situation in about_hover(5, 1e-4):
        problem = law.quadratic.over(law.prepare(situation), law.outlook)
        for _ in range(4):
            tried = 1e-4 * rng.uniform(problem.lower, problem.upper)
            flown = law.fly(law.quadratic.plan(tried))[0]
            assert flown.cost == pytest.approx(problem(tried), rel=1e-3)
        assert closed_form(law).cost == pytest.approx(left_to_pay(law, situation), rel=1e-3)


def test_plan_with_a_non_finite_cost_never_wins() -> None:
    law = horizon()
    law.prepare(situations(1, 0.3)[0])
    knots = np.zeros((2, *law.reach.shape))
    knots[0, 0] = np.nan
    _, costs = law.fly(np.zeros((STEPS, 3)), knots=knots)
    assert (int(np.argmin(costs)), costs[0]) == (1, math.inf)


def test_unbounded_quadratic_optimum_is_the_lqr() -> None:
    """With terminal cost P, N optimal inputs cost x'Px for every N, and the first one is -K x."""
    law = horizon()
    for situation in situations(5, 0.3):
        first = law.prepare(situation)
        problem, box, b_z = law.quadratic.over(first, law.outlook), first.quadratic, first.b_z
        best = np.linalg.solve(problem.hessian, -problem.gradient)
        assert float(problem(best)) == pytest.approx(left_to_pay(law, situation), rel=1e-8)
        assert best[0] == pytest.approx(-law.lateral.gain @ first.at_hover[:, 0], abs=1e-8)
        assert best[2 * STEPS] == pytest.approx(-law.vertical.gain @ first.vertical, abs=1e-8)
        for ours, theirs in ((problem.lower, box.lower), (problem.upper, box.upper)):
            inputs = first.inputs(law.quadratic.plan(ours)[0])
            assert inputs[:3] == pytest.approx(theirs[:3], abs=1e-9)
            assert inputs[0] * b_z == pytest.approx(theirs[0] * b_z, rel=1e-9)


PUSHED_MPS2 = np.array([2.0, -1.5, 0.0])  # a disturbance, against which a hover leans


def _flown(state: PredictedState, plan: np.ndarray) -> np.ndarray:
    """[p, v, b, b', T] (11,) after `plan`, offsets from the leaning hover, integrated by SciPy."""
    wn, z, c = PX4.tilt.natural_frequency_radps, PX4.tilt.damping, PX4.drag_per_mass_ps
    pull = np.array([0.0, 0.0, G]) + PUSHED_MPS2
    leaning = pull / np.linalg.norm(pull)

    def motion(_: float, x: np.ndarray, tilt: np.ndarray, thrust: float) -> np.ndarray:
        b_z = math.sqrt(1.0 - x[6] ** 2 - x[7] ** 2)
        acceleration = pull - x[10] * np.array([x[6], x[7], b_z]) - c * x[3:6]
        twist = wn**2 * (tilt - x[6:8]) - 2.0 * z * wn * x[8:10]
        lag = (thrust - x[10]) / PX4.thrust_lag_s
        return np.concatenate((x[3:6], acceleration, x[8:10], twist, [lag]))

    x = np.concatenate(
        (state.position_ned_m, state.velocity_ned_mps, state.thrust_direction_ned[:2],
         state.thrust_direction_rate_ned_ps[:2], [state.thrust_mps2])
    )  # fmt: skip
    for north, east, down in plan:
        thrust = (pull[2] + down) / math.sqrt(1.0 - x[6] ** 2 - x[7] ** 2)
        held = (leaning[:2] + np.array([north, east]), thrust)
        x = solve_ivp(motion, (0, PERIOD_S), x, args=held, rtol=1e-9, atol=1e-10).y[:, -1]
    return x


def test_nonlinear_rollouts_agree_with_scipy() -> None:
    """After 1 s of tilts up to 0.2 and thrusts up to 3 m/s^2 about a hover that leans by 15
    degrees, position and velocity agree within 4 mm and 10 mm/s."""
    state = replace(
        at((0.2, -0.1, -3.3), 0.0),
        time_s=5.057,
        velocity_ned_mps=np.array([0.3, 0.2, -0.1]),
        thrust_direction_ned=np.array([0.2, -0.1, math.sqrt(0.95)]),
        thrust_direction_rate_ned_ps=np.array([0.1, -0.2, 0.0]),
        thrust_mps2=G + 0.5,
        disturbance_ned_mps2=PUSHED_MPS2,
    )
    plan = np.random.default_rng(3).uniform([-0.1, -0.2, -3.0], [0.2, 0.1, 3.0], (STEPS, 3))
    true, law = _flown(state, plan), horizon()
    law.prepare(Situation(5.0, state, hold((0.0, 0.0, -3.0), 0.0), LEVEL))
    rolled = law.fly(plan)[0].states[-1]
    assert np.abs(rolled[[P, P + 1, Z]] - [0.0, 0.0, 3.0] - true[:3]).max() < 0.004
    assert np.abs(rolled[[V, V + 1, W]] - true[3:6]).max() < 0.01
    pull = np.array([0.0, 0.0, G]) + PUSHED_MPS2
    leaning = pull[:2] / np.linalg.norm(pull)
    assert rolled[B : B + 2] + leaning == pytest.approx(true[6:8], abs=1e-6)
    assert rolled[T] + np.linalg.norm(pull) == pytest.approx(true[10], abs=1e-3)


def test_zero_plan_flies_the_reference() -> None:
    reference, law = lemniscate(8.0, vertical_m=0.4), horizon()
    start = state_of(np.random.default_rng(0), reference, 0.0)
    state = on_target(start, law.target(reference, 5.0, start))
    law.prepare(Situation(5.0, state, reference, LEVEL))
    plan = law.fly(np.zeros((STEPS, 3)))[0]
    assert np.abs(plan.states).max() < 1e-9
    assert plan.cost < 1e-12


def test_mpc_equals_lqr_only_away_from_bounds() -> None:
    mpc, closed = MpcLaw(PX4, MpcSettings(bandwidth_radps=5.0)), lqr()
    for situation in situations(20, 0.1):
        ours, theirs = mpc.decide(situation).command, closed.decide(situation).command
        assert ours.thrust_mps2 == pytest.approx(theirs.thrust_mps2, abs=1e-6)
        assert ours.thrust_direction_ned == pytest.approx(theirs.thrust_direction_ned, abs=1e-7)
    tight = MpcLaw(PX4, MpcSettings(bandwidth_radps=5.0, feedback_limit=0.02))
    clipped = lqr(feedback_limit=0.02)
    apart = [
        abs(tight.decide(s).command.thrust_direction_ned[0]
            - clipped.decide(s).command.thrust_direction_ned[0])
        for s in situations(40, 0.2)
    ]  # fmt: skip
    assert max(apart) > 0.01


def test_law_finds_cheaper_plans_than_a_random_search() -> None:
    """Past a moving sphere each plan of the law, found by about 900 roll-outs from the closed form,
    costs less than the best of 2800 random ones about it; most cost less than half."""
    law, rng, paid = horizon(keep_out=[PASSING]), np.random.default_rng(7), []
    for situation in situations(10, 0.3, seed=7):
        law.previous = None
        ours, base = law.decide(situation).certificate.cost, closed_form(law)
        knots = law.reach * rng.uniform(-1.0, 1.0, (2800, *law.reach.shape))
        paid.append((ours, law.fly(base.inputs, base.states, knots)[1].min()))
    ours, drawn = np.array(paid).T
    assert (ours < drawn).all()
    assert np.median(ours / drawn) < 0.5


def test_plan_near_the_ground_is_penalised() -> None:
    """Below 0.3 m a plan pays 20 per metre and second, and 200 per square metre and second. A
    descent from 0.8 m and its mirror image differ in cost by that alone."""
    law = horizon(keep_out=[IN_THE_WAY])
    law.prepare(Situation(5.0, at((5.0, 5.0, -0.8), 0.0), hold((5.0, 5.0, -0.8), 0.0), LEVEL))
    down = np.zeros((STEPS_AROUND, 3))
    down[:5, 2] = -3.0
    low, high = law.fly(down)[0], law.fly(-down)[0]
    assert low.states[:, Z] == pytest.approx(-high.states[:, Z], abs=1e-9)
    over = np.maximum(low.states[1:, Z] - 0.5, 0.0)
    assert over.max() > 0.1
    paid = PERIOD_S * np.sum(20.0 * over + 200.0 * over**2)
    assert low.cost - high.cost == pytest.approx(paid, rel=1e-9)


def test_plan_at_the_deadline_is_no_worse_than_the_base() -> None:
    remaining_s = iter(range(4, -1000, -1))
    (situation,) = situations(1, 0.3)
    law = horizon(keep_out=[IN_THE_WAY])
    decision = law.decide(replace(situation, remaining_s=lambda: next(remaining_s)))
    assert decision.certificate.cut_short
    assert 1 <= decision.certificate.iterations <= 5
    assert decision.certificate.cost <= decision.certificate.seed_cost
    assert np.linalg.norm(decision.command.thrust_direction_ned) == pytest.approx(1.0)


def test_speed_limit_slows_the_plan() -> None:
    """While the reference moves at 1.5 m/s and more, a plan with a limit of 1 m/s ends slower."""
    (situation,) = situations(1, 0.05, seed=4)
    fastest = {}
    for limit in (None, 1.0):
        law = horizon(speed_limit_mps=limit)
        law.decide(situation)
        assert law.previous is not None
        last = law.previous[1].states[-1]
        node = law.outlook["velocities"][0, 2 * STEPS]
        fastest[limit] = float(np.linalg.norm(node + np.array([last[V], last[V + 1], last[W]])))
    assert fastest[None] > 1.4
    assert fastest[1.0] < 1.1
