"""The tracking law: gains flown on PX4, the cost it claims, its bounds, and whole short flights.

Flights run against `attitude_plant`, whose estimator errs as PX4's does; figures in brackets are
those measured on PX4 itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from attitude_plant import Flight, Lemniscate, Truth, fly
from laws import ARDUCOPTER, LEVEL, PX4, G, lqr, on_target, pso, state_of
from scipy.linalg import expm

from offboard.control.base import Controller, DecisionError, Situation
from offboard.control.law import PsoLaw
from offboard.control.swarm import SwarmSettings
from offboard.model.axes import lateral_model, lead, vertical_model
from offboard.model.command import Command, PredictedState
from offboard.model.vehicle import Vehicle
from offboard.reference.base import FlatSample

# ---------------------------------------------------------------- the law on paper


@pytest.mark.parametrize(
    ("bandwidth", "lateral", "vertical"),
    [
        (5.0, [-1.87, -0.667, 0.624, 0.041], [-18.5, -5.84, 0.26]),
        (7.0, [-3.20, -0.975, 0.901, 0.055], [-31.7, -8.23, 0.35]),
    ],
)
def test_gains_are_those_flown_on_px4(
    bandwidth: float, lateral: list[float], vertical: list[float]
) -> None:
    law = lqr(bandwidth)
    digits = [2, 3, 3, 3]
    assert [round(k, d) for k, d in zip(law.lateral.gain, digits, strict=True)] == lateral
    digits = [1, 2, 2]
    assert [round(k, d) for k, d in zip(law.vertical.gain, digits, strict=True)] == vertical


@pytest.mark.parametrize("vehicle", [PX4, ARDUCOPTER], ids=["px4", "arducopter"])
def test_cost_is_the_sum_it_stands_for(vehicle: Vehicle) -> None:
    """J(u; x) against 30 s of flight in steps of 1 ms: u held for one period, then -K x; error and
    input count at each decision."""
    law = lqr(vehicle=vehicle)
    rng = np.random.default_rng(4)
    pairs = [
        (lateral_model(vehicle), law.lateral, G**2 / 5.0**4),
        (vertical_model(vehicle), law.vertical, 5.0**-4),
    ]
    for model, to_go, effort in pairs:
        size = len(model.dynamics)
        block = np.zeros((size + 1, size + 1))
        block[:size, :size], block[:size, size:] = model.dynamics, model.input_map
        step = expm(block * 1e-3)
        start = rng.normal(size=size) * [1.0, 1.0, 0.1, 0.5][:size]
        best = -float(to_go.gain @ start)
        for held in (best, best + 0.2, -0.1):
            x, u, cost = start.copy(), held, 0.0
            for i in range(30_000):
                if i % 100 == 0:
                    u = -float(to_go.gain @ x) if i else u
                    cost += 0.1 * (x[0] ** 2 + effort * u**2)
                x = step[:size] @ np.array([*x, u])
            claimed = 0.5 * to_go.curvature * held**2 + to_go.coupling @ start * held
            claimed += 0.5 * start @ to_go.state_cost @ start
            assert claimed == pytest.approx(cost, rel=1e-4)


def test_lead_inverts_the_second_order_response() -> None:
    """The response to lead(s) of s = sin 2t is s, with SciPy's transfer function at 2 rad/s."""
    t = np.linspace(0, 3, 7)
    commanded = lead(np.sin(2 * t), 2 * np.cos(2 * t), -4 * np.sin(2 * t), PX4.tilt)
    s = 2j
    response = 11.4**2 / (s**2 + 2 * 0.56 * 11.4 * s + 11.4**2)
    assert commanded == pytest.approx((np.exp(s * t) / response).imag)


def slope_of_force(reference: Lemniscate, vehicle: Vehicle, state: PredictedState) -> np.ndarray:
    """d(T b) / db (2, 2), by differences, at the direction that the reference asks for and with the
    vertical force that carries the weight; symmetric."""
    sample = reference.sample(state.time_s)
    force = np.array([0.0, 0.0, G]) - sample.acceleration_ned_mps2
    force += state.disturbance_ned_mps2 - vehicle.drag_per_mass_ps * sample.velocity_ned_mps
    b, step = force[:2] / np.linalg.norm(force), 1e-6
    carried = force[2] * G / (G + state.disturbance_ned_mps2[2])

    def push(b: np.ndarray) -> np.ndarray:
        return carried * b / math.sqrt(1.0 - b @ b)

    return np.array([(push(b + e) - push(b - e)) / (2.0 * step) for e in step * np.eye(2)])


def test_unconstrained_minimiser_is_the_lqr_law() -> None:
    """u* = -f / h: b_c = b_ff - K [p, v, b, b'], T b_z = f_ff - Kz [z, v_z, f_z]; heading led.

    p and v are those for which b in hover does what b does here, by the slope of the force."""
    law, rng, reference = lqr(), np.random.default_rng(1), Lemniscate(15.0)
    for _ in range(20):
        state = state_of(rng, reference, 0.3)
        task = law.task(Situation(5.0, state, reference, LEVEL))
        target, problem = task.target, task.problem
        minimiser = np.linalg.solve(problem.hessian, -problem.gradient)
        north_east = np.array(
            (state.position_ned_m, state.velocity_ned_mps, state.thrust_direction_ned,
             state.thrust_direction_rate_ned_ps)
        )[:, :2]  # fmt: skip
        off, b_z = north_east - target.lateral, state.thrust_direction_ned[2]
        off[:2] = off[:2] @ np.linalg.inv(slope_of_force(reference, law.vehicle, state)) * G
        down = (state.position_ned_m[2], state.velocity_ned_mps[2], state.thrust_mps2 * b_z)
        vertical = np.array(down) - target.vertical
        expected_tilt = target.feedforward[:2] - law.lateral.gain @ off
        force = target.feedforward[2] - law.vertical.gain @ vertical
        assert minimiser[1:3] == pytest.approx(expected_tilt, abs=1e-9)
        assert minimiser[0] == pytest.approx(force / b_z, abs=1e-9)
        assert minimiser[3] == pytest.approx(target.heading_rad)
        # what an optimal law has left to pay is x' P x
        left = np.sum(off * (law.lateral.terminal @ off))
        left += vertical @ law.vertical.terminal @ vertical
        assert float(problem(minimiser)) == pytest.approx(left, rel=1e-9)


def test_cost_vanishes_on_the_reference_and_never_goes_below_zero() -> None:
    law, rng, reference = lqr(), np.random.default_rng(2), Lemniscate(15.0)
    for size in (0.0, 0.1, 1.0):
        state = state_of(rng, reference, size)
        task = law.task(Situation(5.0, state, reference, LEVEL))
        target, problem = task.target, task.problem
        assert problem(np.linalg.solve(problem.hessian, -problem.gradient)) > -1e-9
    on_it = on_target(state, target)
    b_z = on_it.thrust_direction_ned[2]
    nominal = [target.feedforward[2] / b_z, *target.feedforward[:2], target.heading_rad]
    problem = law.task(Situation(5.0, on_it, reference, LEVEL)).problem
    cost = float(problem(np.array(nominal)))
    assert cost == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("size", "least", "most"), [(0.01, 0, 0), (1, 20, 50), (10, 50, 50)])
def test_bounds_hold_and_the_feedback_is_limited(size: float, least: int, most: int) -> None:
    law, rng, reference = lqr(), np.random.default_rng(3), Lemniscate(8.0)
    touched, limit = 0, math.sin(PX4.tilt_max_rad)
    for _ in range(50):
        state = state_of(rng, reference, size)
        target = law.target(reference, 5.0, state)
        decision = law.decide(Situation(5.0, state, reference, LEVEL))
        tilt = np.array(decision.command.thrust_direction_ned)
        fed_forward = np.clip(target.feedforward[:2], -limit, limit)
        assert np.abs(tilt[:2] - fed_forward).max() <= 0.3 + 1e-12
        assert np.abs(tilt[:2]).max() <= limit + 1e-12
        assert np.linalg.norm(tilt) == pytest.approx(1.0)
        assert 0.2 * G <= decision.command.thrust_mps2 <= G / 0.4895
        touched += decision.certificate.at_bound
    assert least <= touched <= most


def test_swarm_finds_the_closed_form() -> None:
    """The swarm of the paper on the cost-to-go: the exact optimum to a millionth of the box."""
    swarm, closed = pso(), lqr()
    rng, reference = np.random.default_rng(5), Lemniscate(8.0)
    for size in (0.05, 0.3, 3.0):
        state = state_of(rng, reference, size)
        situation = Situation(5.0, state, reference, LEVEL)
        ours, exact = swarm.decide(situation), closed.decide(situation)
        assert ours.command.thrust_mps2 == pytest.approx(exact.command.thrust_mps2, abs=1e-5)
        assert ours.command.thrust_direction_ned == pytest.approx(
            exact.command.thrust_direction_ned, abs=1e-6
        )
        assert ours.command.heading_rad == pytest.approx(exact.command.heading_rad, abs=1e-6)
        assert ours.certificate.gap < 1e-6
        assert exact.certificate.gap == 0.0
        assert ours.certificate.optimal_cost == pytest.approx(exact.certificate.cost, rel=1e-6)


def test_too_low_means_more_thrust_and_tilt_is_paid_for() -> None:
    law, reference = lqr(), Lemniscate(15.0, run_in_s=1e9)
    rest = replace(state_of(np.random.default_rng(0), reference, 0.0), velocity_ned_mps=np.zeros(3))
    lower = replace(rest, position_ned_m=rest.position_ned_m + np.array([0, 0, 0.1]))
    command = law.decide(Situation(5.0, lower, reference, LEVEL)).command
    assert command.thrust_mps2 == pytest.approx(G + 1.85, abs=0.01)
    tilted = replace(rest, thrust_direction_ned=np.array([0.6, 0.0, 0.8]), thrust_mps2=G / 0.8)
    command = law.decide(Situation(5.0, tilted, reference, LEVEL)).command
    assert command.thrust_mps2 == pytest.approx(G / 0.8, rel=1e-6)


def test_reset_gives_the_same_decisions_again_and_seeds_differ() -> None:
    settings = SwarmSettings(particles=10, iterations=5)
    rng, reference = np.random.default_rng(7), Lemniscate(8.0)
    situation = Situation(5.0, state_of(rng, reference, 0.3), reference, LEVEL)

    def decisions(law: PsoLaw) -> list[Command]:
        return [law.decide(situation).command for _ in range(3)]

    law = pso(swarm=settings)
    first = decisions(law)
    law.reset()
    assert decisions(law) == first
    assert decisions(law) != first
    assert decisions(pso(swarm=settings, seed=1)) != first


def test_what_is_not_finite_is_no_decision() -> None:
    reference = Lemniscate(8.0)
    for law in (pso(), lqr()):
        state = state_of(np.random.default_rng(0), reference, 0.1)
        for broken in (math.nan, math.inf):
            wrong = replace(state, velocity_ned_mps=np.array([0.0, broken, 0.0]))
            with np.errstate(invalid="ignore"), pytest.raises(DecisionError, match="not finite"):
                law.decide(Situation(5.0, wrong, reference, LEVEL))


def test_the_deadline_cuts_the_swarm_short() -> None:
    remaining_s = iter((0.02, 0.0))
    reference = Lemniscate(8.0)
    state = state_of(np.random.default_rng(0), reference, 0.1)
    situation = Situation(5.0, state, reference, LEVEL, lambda: next(remaining_s))
    certificate = pso().decide(situation).certificate
    assert certificate.cut_short
    assert certificate.iterations == 50


# ---------------------------------------------------------------- flights


def flight(
    bandwidth: float = 5.0,
    period_s: float = 15.0,
    seed: int = 1,
    truth: Truth | None = None,
    vehicle: Vehicle = PX4,
    laps: float = 1.0,
    make: Callable[..., Controller] = lqr,
    feedback_limit: float = 0.3,
    **more: object,
) -> Flight:
    law = make(bandwidth, vehicle, feedback_limit=feedback_limit)
    truth = truth or Truth(vehicle)
    reference = more.pop("reference", None) or Lemniscate(period_s)
    return fly(truth, law, vehicle, reference, seed, laps=laps, **more)


def test_without_noise_the_reference_is_flown_to_a_millimetre() -> None:
    silent = Truth(PX4, noisy=False)
    assert flight(period_s=15.0, truth=silent).rmse_m < 0.0005
    assert flight(period_s=8.0, truth=silent).rmse_m < 0.0011
    heaving = Lemniscate(8.0, heave_m=0.3)
    assert flight(period_s=8.0, truth=silent, reference=heaving).rmse_m < 0.002


@pytest.mark.parametrize(
    ("bandwidth", "period_s", "bound_m"),
    [(3, 15, 0.044), (5, 15, 0.036), (7, 15, 0.035), (10, 15, 0.038), (7, 8, 0.040)],
)
def test_px4s_estimator_is_tracked_to_centimetres(
    bandwidth: float, period_s: float, bound_m: float
) -> None:
    """wc 3 / 5 / 7 / 10 on lem15 [.052 .037 .031 .030], wc 7 on lem8 [.035]."""
    assert 0.02 < flight(bandwidth, period_s).rmse_m < bound_m


def test_the_swarm_flies_like_the_closed_form() -> None:
    ours, exact = flight(make=pso, laps=0.3), flight(laps=0.3)
    assert ours.rmse_m == pytest.approx(exact.rmse_m, abs=1e-5)


@dataclass
class WithoutFeedforward(Lemniscate):
    """Position and velocity only."""

    def sample(self, time_s: float | np.ndarray) -> FlatSample:
        sample = super().sample(time_s)
        zero = np.zeros_like(sample.position_ned_m)
        return replace(sample, acceleration_ned_mps2=zero, jerk_ned_mps3=zero, snap_ned_mps4=zero)


def test_feedforward_of_the_attitude_is_worth_a_factor() -> None:
    """[lem8: .145 without, .035 with]"""
    assert flight(7.0, 8.0, reference=WithoutFeedforward(8.0)).rmse_m > 0.1


@pytest.mark.parametrize("scale", [1 / 1.15, 1 / 0.85])
def test_wrong_hover_thrust_is_absorbed(scale: float) -> None:
    """[wc 7: .032 too weak, .038 too strong]"""
    result = flight(7.0, truth=Truth(PX4, thrust_scale=scale))
    assert result.rmse_m < 0.04
    hover = result.observer.hover_thrust_estimate
    assert hover == pytest.approx(PX4.hover_thrust / scale, rel=0.03)


def test_wind_is_absorbed() -> None:
    """[N 2 E 2 m/s on a drag of 1.02: .035]"""
    push = (2.04, 2.04, 0.0)
    assert flight(truth=Truth(PX4, wind_force_ned_mps2=push)).rmse_m < 0.04


def test_sixty_milliseconds_of_unknown_delay_are_survived() -> None:
    """[wc 5: .047]"""
    assert flight(truth=Truth(PX4, extra_delay_s=0.06)).rmse_m < 0.05


@pytest.mark.parametrize(("tilt_s", "thrust_s"), [(0.177, 0.135), (0.177, 0.015), (0.01, 0.13)])
def test_a_known_delay_costs_little(tilt_s: float, thrust_s: float) -> None:
    """60 ms more each way, told to the controller [wc 5: .051, wc 7: .050]; tilt and thrust may
    act at quite different times, because each loop is closed where its own command acts."""
    tilt = PX4.tilt.model_copy(update={"delay_s": tilt_s})
    slow = PX4.model_copy(update={"tilt": tilt, "thrust_delay_s": thrust_s})
    result = flight(7.0, vehicle=slow)
    assert result.rmse_m < 0.05
    assert result.at_bound < 0.25


def test_position_at_thirty_hertz_is_enough() -> None:
    """[.037]"""
    assert flight(gaps_s=(0.033,)).rmse_m < 0.04


@pytest.mark.parametrize("vehicle", [PX4, ARDUCOPTER], ids=["px4", "arducopter"])
@pytest.mark.parametrize("offset", [(2.0, -1.0, 1.0), (10.0, -5.0, 3.0)])
def test_engaging_off_the_reference_ends_on_it(
    vehicle: Vehicle, offset: tuple[float, float, float]
) -> None:
    """No overshoot to speak of and no cycle between the bounds, at wc 7, with the loop's limit on
    angular acceleration."""
    result = flight(
        7.0, vehicle=vehicle, truth=Truth(vehicle, noisy=False), offset_ned_m=offset,
        score_from_s=14.0, laps=0.3,
    )  # fmt: skip
    assert result.largest_m < 0.005


@dataclass
class Hover(Lemniscate):
    """At 3 m above the start."""

    def sample(self, time_s: float | np.ndarray) -> FlatSample:
        still = np.zeros((*np.shape(time_s), 3))
        place = still + np.array([0.0, 0.0, -3.0])
        zero = still[..., 0]
        return FlatSample(place, still, still, still, still, zero, zero, zero)


def test_a_vehicle_that_leans_by_39_degrees_comes_to_rest() -> None:
    """[circle of 8 m/s at 42 degrees: with the gain of hover a cycle of 0.05 m, without noise]"""
    storm = Truth(PX4, wind_force_ned_mps2=(7.9, 0.0, 0.0), noisy=False)
    result = flight(
        7.0, truth=storm, reference=Hover(8.0), offset_ned_m=(0.5, 0.5, 0.0), score_from_s=14.0
    )
    assert result.largest_m < 0.003


def test_limited_feedback_cures_the_limit_cycle() -> None:
    """ArduCopter's acceleration limit, noise and wc 7 [.120 unlimited, .029 with .3]."""
    truth = Truth(ARDUCOPTER)
    limited = flight(7.0, vehicle=ARDUCOPTER, truth=truth)
    free = flight(7.0, vehicle=ARDUCOPTER, truth=truth, feedback_limit=1.0)
    assert limited.rmse_m < 0.04
    assert free.rmse_m > 1.3 * limited.rmse_m
    assert free.rate_sd_radps > 1.3 * limited.rate_sd_radps


@dataclass
class Turning(Lemniscate):
    """The heading swings by half a radian."""

    def sample(self, time_s: float | np.ndarray) -> FlatSample:
        sample, t = super().sample(time_s), np.asarray(time_s)
        w = 0.8
        return replace(
            sample,
            heading_rad=0.5 * np.sin(w * t),
            heading_rate_radps=0.5 * w * np.cos(w * t),
            heading_acceleration_radps2=-0.5 * w * w * np.sin(w * t),
        )


def test_a_turning_heading_is_led_and_does_not_leak_into_position() -> None:
    reference = Turning(15.0)
    result = flight(truth=Truth(PX4, noisy=False), reference=reference)
    assert result.rmse_m < 0.0005
    state = result.observer.predict(result.end_s - PX4.tilt.delay_s)
    assert state.heading_rad == pytest.approx(
        float(reference.sample(result.end_s).heading_rad), abs=0.01
    )
