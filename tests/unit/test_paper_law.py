"""The paper's law: what it decides, and its flight over attitude setpoints."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from offboard.control.base import DecisionError, Situation
from offboard.control.swarm import SwarmSettings
from offboard.documents.reading import parse
from offboard.model.command import Command, PredictedState
from offboard.model.rigid_body import hover_matrices, sampled_matrices
from offboard.model.vehicle import Vehicle
from offboard.paper.controller import (
    PaperController,
    PaperLaw,
    PaperSettings,
    flyable_box,
    heading_frame,
    input_scale,
)
from offboard.paper.law import ErrorIntegral, IntegralSettings
from offboard.reference.base import FlatSample
from offboard.run.configuration import load

Array = NDArray[np.float64]

FILES = sorted((Path(__file__).parents[2] / "config" / "vehicles").glob("*.yaml"))
VEHICLES = {path.stem: parse(path.read_text(), Vehicle, path.stem) for path in FILES}
PAPER = VEHICLES["paper"]


class Straight:
    """A reference that leaves `position_ned_m` at time 0 with a constant velocity."""

    duration_s = 1e6

    def __init__(self, position: Array, velocity: Array, heading: float) -> None:
        self.position, self.velocity, self.heading = position, velocity, heading

    def sample(self, time_s: float | Array) -> FlatSample:
        zero = np.zeros(3)
        now = self.position + self.velocity * time_s
        still = np.zeros(())
        return FlatSample(
            now, self.velocity, zero, zero, zero, np.float64(self.heading) + still, still, still
        )


def state_at(
    position: Array, velocity: Array, phi: float, theta: float, psi: float, rates: Array
) -> PredictedState:
    attitude = Rotation.from_euler("ZYX", [psi, theta, phi]).as_matrix()
    return PredictedState(
        time_s=0.0,
        position_ned_m=position,
        velocity_ned_mps=velocity,
        thrust_direction_ned=attitude[:, 2],
        thrust_direction_rate_ned_ps=np.zeros(3),
        heading_rad=psi,
        heading_rate_radps=0.0,
        thrust_mps2=9.81,
        disturbance_ned_mps2=np.zeros(3),
        rates_frd_radps=rates,
    )


HOVER = Command(9.81, (0.0, 0.0, 1.0), 0.0)


def tilted(heading: float) -> tuple[PredictedState, Straight]:
    """The same situation, seen from the vehicle, at any heading."""
    turn = Rotation.from_euler("Z", heading)
    state = state_at(
        turn.apply([1.0, -2.0, 0.5]), turn.apply([0.8, 0.3, -0.2]), 0.08, -0.05, heading,
        np.array([0.1, -0.2, 0.05]),
    )  # fmt: skip
    velocity = turn.apply([1.0, 0.5, -0.1])
    goal_rad = np.remainder(heading + 0.1 + np.pi, 2 * np.pi) - np.pi  # across the wrap at 3.1
    return state, Straight(turn.apply([1.5, -1.0, 0.2]), velocity, float(goal_rad))


# ---------------------------------------------------------------- the law on the paper's plant


def test_the_input_applied_last_is_what_r_du_holds_on_to() -> None:
    """Eq. 21's last term: its slope is -2 R_du u(k-1); a reset forgets u(k-1)."""
    settings = PaperSettings(rate=(1.0, 2.0, 3.0, 4.0))
    law = PaperLaw(*sampled_matrices(PAPER, 0.1), settings)
    state = np.linspace(-0.05, 0.06, 12)
    first, second = law.move(state, np.zeros(12)), law.move(state, np.zeros(12))
    change = second.problem.gradient - first.problem.gradient
    assert np.abs(first.inputs).min() > 1e-3
    assert change == pytest.approx(-2 * np.array([1, 2, 3, 4]) * first.inputs, rel=1e-9)
    law.reset()
    again = law.move(state, np.zeros(12))
    assert np.array_equal(again.problem.gradient, first.problem.gradient)


# ---------------------------------------------------------------- over attitude setpoints


def test_the_heading_frame_is_eq_5_at_heading_north() -> None:
    state, reference = tilted(0.0)
    vector, target = heading_frame(state, reference.sample(0.1))
    expected = [0.08, -0.05, -0.1, 0.1, -0.2, 0.05, 0.8, 0.3, -0.2]
    assert vector[:9] == pytest.approx(expected, abs=1e-12)
    assert vector[9:] == pytest.approx([1 - 1.6, -2 + 0.95, 0.5 - 0.19], abs=1e-12)
    assert target == pytest.approx([0] * 6 + [1.0, 0.5, -0.1] + [0] * 3, abs=1e-12)


SUMMED = IntegralSettings(weights=(80.0, 80.0, 15.0, 50.0))


@pytest.mark.parametrize("settings", [PaperSettings(), PaperSettings(integral=SUMMED)])
@pytest.mark.parametrize("heading", [-2.9, 3.1])
def test_the_law_is_the_same_at_every_heading(heading: float, settings: PaperSettings) -> None:
    """With the sum of three decisions, where there is one."""
    controller = PaperController(PAPER, settings)
    commands = []
    for seen_from in (0.0, heading):
        controller.reset()
        state, reference = tilted(seen_from)
        for _ in range(3):
            decision = controller.decide(Situation(0.0, state, reference, HOVER))
        commands.append(decision.command)
    north, turned = commands
    direction = Rotation.from_euler("Z", heading).apply(north.thrust_direction_ned)
    assert turned.thrust_direction_ned == pytest.approx(direction, abs=1e-6)
    assert turned.thrust_mps2 == pytest.approx(north.thrust_mps2, abs=1e-6)
    apart = turned.heading_rad - north.heading_rad - heading
    assert np.sin(apart / 2) == pytest.approx(0.0, abs=1e-6)
    assert abs(turned.heading_rad) <= np.pi


def test_what_is_sent_is_the_attitude_of_the_next_state() -> None:
    state, reference = tilted(0.4)
    command = PaperController(PAPER).decide(Situation(0.0, state, reference, HOVER)).command
    dynamics, inputs = sampled_matrices(PAPER, 0.1)
    settings = PaperSettings()
    law = PaperLaw(dynamics, inputs, settings, *flyable_box(PAPER, settings))
    move = law.move(*heading_frame(state, reference.sample(0.1)))
    following = dynamics @ heading_frame(state, reference.sample(0.1))[0] + inputs @ move.inputs
    phi, theta, psi = following[:3] + np.array([0.0, 0.0, reference.heading])
    attitude = Rotation.from_euler("ZYX", [psi, theta, phi]).as_matrix()
    assert command.thrust_direction_ned == pytest.approx(attitude[:, 2], abs=1e-9)
    assert command.heading_rad == pytest.approx(psi, abs=1e-9)
    assert command.thrust_mps2 == pytest.approx(9.81 + move.inputs[0] / 0.4, abs=1e-9)


@pytest.mark.parametrize("vehicle", VEHICLES.values(), ids=VEHICLES.keys())
def test_an_input_accelerates_every_vehicle_as_it_does_the_papers(vehicle: Vehicle) -> None:
    _, theirs = hover_matrices(PAPER)
    _, ours = hover_matrices(vehicle)
    assert ours * input_scale(vehicle) == pytest.approx(theirs, abs=1e-12)
    lower, upper = flyable_box(vehicle, PaperSettings())
    assert lower[1:] == pytest.approx([-0.2, -0.2, -0.1])
    assert upper[1:] == pytest.approx([0.2, 0.2, 0.1])
    thrusts = vehicle.gravity_mps2 + np.array([lower[0], upper[0]]) / 0.4
    assert thrusts[0] == pytest.approx(0.0, abs=1e-12)
    assert thrusts[1] <= vehicle.thrust_max_mps2 + 1e-12
    assert upper[0] <= 3.942


def test_a_turn_goes_the_short_way_round() -> None:
    state = state_at(np.zeros(3), np.zeros(3), 0.0, 0.0, 3.1, np.zeros(3))
    reference = Straight(np.zeros(3), np.zeros(3), -3.1)
    command = PaperController(PAPER).decide(Situation(0.0, state, reference, HOVER)).command
    assert 3.1 < command.heading_rad <= np.pi


def test_full_deflection_stays_within_what_the_vehicle_can() -> None:
    controller = PaperController(PAPER)
    thrusts = []
    for down in (1000.0, -1000.0):
        reference = Straight(np.array([0, 0, down]), np.zeros(3), 0.0)
        state = state_at(np.zeros(3), np.zeros(3), 0.0, 0.0, 0.0, np.zeros(3))
        decision = controller.decide(Situation(0.0, state, reference, HOVER))
        assert decision.certificate.at_bound
        thrusts.append(decision.command.thrust_mps2)
    assert thrusts == pytest.approx([0.0, PAPER.thrust_max_mps2], abs=1e-9)


@pytest.mark.parametrize(
    "field", ["position_ned_m", "velocity_ned_mps", "thrust_direction_ned", "rates_frd_radps"]
)
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_a_state_without_a_finite_cost_gives_no_decision(field: str, value: float) -> None:
    state, reference = tilted(0.3)
    spoilt = replace(state, **{field: np.array([value, 0.0, 1.0])})
    controller = PaperController(PAPER)
    situation = Situation(0.0, spoilt, reference, HOVER)
    if field == "thrust_direction_ned" and value == 1e300:  # a direction, however long
        command = controller.decide(situation).command
        assert np.isfinite([command.thrust_mps2, *command.thrust_direction_ned]).all()
        assert np.linalg.norm(command.thrust_direction_ned) == pytest.approx(1.0)
        return
    reason = "cost of this decision" if value == 1e300 else "predicted state"
    with np.errstate(all="ignore"), pytest.raises(DecisionError, match=reason):
        controller.decide(situation)


def test_flights_with_the_same_seed_decide_the_same() -> None:
    state, reference = tilted(1.0)
    situation = Situation(0.0, state, reference, HOVER)
    few = SwarmSettings(iterations=10)
    controller, same_seed, other = (
        PaperController(PAPER, PaperSettings(swarm=few), seed=seed) for seed in (1, 1, 2)
    )
    first, second = (controller.decide(situation).command for _ in range(2))
    assert [same_seed.decide(situation).command for _ in range(2)] == [first, second]
    assert first != second
    assert other.decide(situation).command != first
    controller.reset()
    assert controller.decide(situation).command == first


def test_a_deadline_is_kept() -> None:
    """The time left is asked for after every 25 iterations."""
    remaining_s = iter((0.002, 0.001, 0.0))
    state, reference = tilted(1.0)
    controller = PaperController(PAPER)
    hurried = Situation(0.0, state, reference, HOVER, lambda: next(remaining_s))
    certificate = controller.decide(hurried).certificate
    assert certificate.cut_short
    assert certificate.iterations == 75
    unhurried = controller.decide(replace(hurried, remaining_s=None)).certificate
    assert not unhurried.cut_short
    assert unhurried.iterations == 150


def test_every_decision_carries_its_certificate() -> None:
    state, reference = tilted(1.0)
    decision = PaperController(PAPER).decide(Situation(0.0, state, reference, HOVER))
    certificate = decision.certificate
    assert 0 <= certificate.gap < 1e-9
    assert certificate.cost == pytest.approx(certificate.optimal_cost, rel=1e-9)
    assert 0 < certificate.spread < 1e-6
    assert not certificate.at_bound


def test_integral_sums_holds_and_stays_within_its_limits() -> None:
    integral = ErrorIntegral(IntegralSettings(limits=(1.0, 1.0, 1.0, 1.0)), 0.1)
    np.testing.assert_allclose(integral.add(np.array([1.0, -2.0, 0.0, 0.5])), [0.1, -0.2, 0, 0.05])
    np.testing.assert_allclose(integral.add(np.ones(4), held=True), [0.1, -0.2, 0, 0.05])
    np.testing.assert_allclose(integral.add(np.full(4, np.nan)), [0.1, -0.2, 0, 0.05])
    np.testing.assert_allclose(integral.add(np.array([1e3, -1e3, 0, 0])), [1, -1, 0, 0.05])


def test_the_error_is_not_summed_while_an_input_is_at_its_bound() -> None:
    settings = PaperSettings(rate=(0, 0, 0, 0), integral=SUMMED)
    law = PaperLaw(*sampled_matrices(PAPER, 0.1), settings)
    for down_m, held in ((1000.0, True), (0.01, False)):
        law.reset()
        target = np.zeros(12)
        target[11] = down_m
        moves = [law.move(np.zeros(12), target, error=np.full(4, 1e-3)) for _ in range(2)]
        first, second = (move.problem.gradient for move in moves)
        assert np.array_equal(first, second) == held


def body_z(roll: float, pitch: float) -> Array:
    """The axis in NED, at heading 0."""
    level = np.cos(roll)
    return np.array([np.sin(pitch) * level, -np.sin(roll), np.cos(pitch) * level])


def flown_over_an_attitude_loop(
    name: str, target_ned_m: Array, wind_ned_mps: Array, seconds: float
) -> tuple[Array, Array, Array]:
    """A shipped controller on the PX4 vehicle file: a point mass with drag behind a second-order
    attitude loop. Positions, velocities and commanded thrust directions per decision, each (K, 3).
    """
    config = load("paper", choices={"controller": name})
    vehicle = config.vehicle
    controller = config.controller.build(vehicle, period_s=0.1, seed=1)
    position, velocity, tilt, turning = (np.zeros(3) for _ in range(4))
    command = Command(vehicle.gravity_mps2, (0.0, 0.0, 1.0), 0.0)
    flown: list[tuple[Array, Array, Array]] = []
    frequency, damping = vehicle.tilt.natural_frequency_radps, vehicle.tilt.damping
    for tick in range(round(10 * seconds)):
        state = PredictedState(
            0.1 * tick, position, velocity, body_z(*tilt[:2]), np.zeros(3), 0.0, 0.0,
            command.thrust_mps2, np.zeros(3), turning,
        )  # fmt: skip
        situation = Situation(0.1 * tick, state, Straight(target_ned_m, np.zeros(3), 0.0), command)
        command = controller.decide(situation).command
        north, east, down = command.thrust_direction_ned
        asked = np.array([-np.arcsin(east), np.arctan2(north, down), 0.0])
        flown.append((position, velocity, np.array(command.thrust_direction_ned)))
        for _ in range(20):
            turning = turning + 0.005 * (
                frequency**2 * (asked - tilt) - 2 * damping * frequency * turning
            )
            tilt = tilt + 0.005 * turning
            drag = vehicle.drag_per_mass_ps * (velocity - wind_ned_mps)
            pull = -command.thrust_mps2 * body_z(*tilt[:2]) - drag
            pull[2] += vehicle.gravity_mps2
            velocity = velocity + 0.005 * pull
            position = position + 0.005 * velocity
    positions, velocities, directions = (np.array(part) for part in zip(*flown, strict=True))
    return positions, velocities, directions


@pytest.mark.slow
def test_the_integral_holds_a_point_in_wind_over_an_attitude_loop() -> None:
    wind = np.array([1.0, -0.5, 0.0])
    ends = {
        name: np.linalg.norm(flown_over_an_attitude_loop(name, np.zeros(3), wind, 150.0)[0][-1])
        for name in ("paper", "paper_integral")
    }
    assert ends["paper_integral"] < 1e-3
    assert ends["paper"] > 0.1


def test_the_limited_law_keeps_speed_and_tilt_over_an_attitude_loop() -> None:
    far = np.array([150.0, 80.0, -10.0])
    limits = load("paper", choices={"controller": "paper_limited"}).controller.limits
    _, fast, steep = flown_over_an_attitude_loop("paper", far, np.zeros(3), 20.0)
    _, slow, level = flown_over_an_attitude_loop("paper_limited", far, np.zeros(3), 20.0)
    assert np.abs(fast[:, :2]).max() > limits.speed_mps
    assert np.abs(slow[:, :2]).max() <= limits.speed_mps
    assert np.abs(slow[:, 2]).max() <= limits.climb_mps
    tilts = np.abs([np.arcsin(level[:, 1]), np.arctan2(level[:, 0], level[:, 2])])
    assert tilts.max() <= limits.tilt_rad
    assert np.abs(np.arctan2(steep[:, 0], steep[:, 2])).max() > limits.tilt_rad
