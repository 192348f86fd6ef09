"""The paper's law: its decisions, and the attitude setpoints that it sends for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from laws import at
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from offboard.control.base import DecisionError, Situation
from offboard.documents import shipped
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
from offboard.paper.law import IntegralSettings
from offboard.reference.base import FlatSample
from simulator import config

Array = NDArray[np.float64]

VEHICLES = {name: config.vehicle(name) for name in shipped.names("vehicle")}
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
    position: ArrayLike = (0, 0, 0), velocity: ArrayLike = (0, 0, 0), phi: float = 0.0,
    theta: float = 0.0, psi: float = 0.0, rates: ArrayLike = (0, 0, 0),
) -> PredictedState:  # fmt: skip
    attitude = Rotation.from_euler("ZYX", [psi, theta, phi]).as_matrix()
    return replace(
        at(position, psi),
        time_s=0.0,
        velocity_ned_mps=np.array(velocity),
        thrust_direction_ned=attitude[:, 2],
        rates_frd_radps=np.array(rates),
    )


HOVER = Command(9.81, (0.0, 0.0, 1.0), 0.0)


def tilted(heading: float) -> tuple[PredictedState, Straight]:
    """A state and a reference that look the same from the vehicle at any heading."""
    turn = Rotation.from_euler("Z", heading)
    state = state_at(
        turn.apply([1.0, -2.0, 0.5]), turn.apply([0.8, 0.3, -0.2]), 0.08, -0.05, heading,
        (0.1, -0.2, 0.05),
    )  # fmt: skip
    velocity = turn.apply([1.0, 0.5, -0.1])
    goal_rad = np.remainder(heading + 0.1 + np.pi, 2 * np.pi) - np.pi  # across the wrap at 3.1
    return state, Straight(turn.apply([1.5, -1.0, 0.2]), velocity, float(goal_rad))


def test_heading_frame_equals_eq_5_at_heading_north() -> None:
    state, reference = tilted(0.0)
    vector, target = heading_frame(state, reference.sample(0.1))
    expected = [0.08, -0.05, -0.1, 0.1, -0.2, 0.05, 0.8, 0.3, -0.2]
    expected += [1 - 1.6, -2 + 0.95, 0.5 - 0.19]
    assert vector == pytest.approx(expected, abs=1e-12)
    assert target == pytest.approx([0] * 6 + [1.0, 0.5, -0.1] + [0] * 3, abs=1e-12)


SUMMED = IntegralSettings(weights=(80.0, 80.0, 15.0, 50.0))


@pytest.mark.parametrize("settings", [PaperSettings(), PaperSettings(integral=SUMMED)])
def test_paper_law_is_independent_of_the_heading(settings: PaperSettings) -> None:
    """The second heading is near the wrap; three decisions let an integral term accumulate."""
    controller, heading = PaperController(PAPER, settings), 3.1
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


def test_command_is_the_attitude_of_the_next_state() -> None:
    """The oracle is the paper's sampled plant with the inputs that the law decides there."""
    state, reference = tilted(0.4)
    command = PaperController(PAPER).decide(Situation(0.0, state, reference, HOVER)).command
    (dynamics, inputs), settings = sampled_matrices(PAPER, 0.1), PaperSettings()
    law = PaperLaw(dynamics, inputs, settings, *flyable_box(PAPER, settings))
    vector, target = heading_frame(state, reference.sample(0.1))
    applied = law.move(vector, target).inputs
    following = dynamics @ vector + inputs @ applied
    phi, theta, psi = following[:3] + np.array([0.0, 0.0, reference.heading])
    attitude = Rotation.from_euler("ZYX", [psi, theta, phi]).as_matrix()
    assert command.thrust_direction_ned == pytest.approx(attitude[:, 2], abs=1e-9)
    assert command.heading_rad == pytest.approx(psi, abs=1e-9)
    assert command.thrust_mps2 == pytest.approx(9.81 + applied[0] / 0.4, abs=1e-9)


@pytest.mark.parametrize("vehicle", VEHICLES.values(), ids=VEHICLES.keys())
def test_inputs_accelerate_every_vehicle_like_the_papers(vehicle: Vehicle) -> None:
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


def test_non_finite_rates_or_costs_raise_decision_error() -> None:
    state, reference = tilted(0.3)
    for field, value, reason in (
        ("rates_frd_radps", np.nan, "predicted state"),
        ("position_ned_m", 1e300, "cost of this decision"),
    ):
        spoilt = replace(state, **{field: np.array([value, 0.0, 1.0])})
        with np.errstate(all="ignore"), pytest.raises(DecisionError, match=reason):
            PaperController(PAPER).decide(Situation(0.0, spoilt, reference, HOVER))


def test_error_sum_is_limited_and_held_at_input_bounds() -> None:
    """The sum acts on the gradient of the cost; at its limits more error changes nothing."""
    narrow = SUMMED.model_copy(update={"limits": (0.1, 0.1, 0.1, 0.1)})

    def slopes(summed: IntegralSettings, down_m: float, *errors: float) -> list[Array]:
        settings = PaperSettings(rate=(0, 0, 0, 0), integral=summed)
        law = PaperLaw(*sampled_matrices(PAPER, 0.1), settings)
        target = np.append(np.zeros(11), down_m)
        moves = [law.move(np.zeros(12), target, error=np.full(4, each)) for each in errors]
        return [move.problem.gradient for move in moves]

    rising, full, more, unknown, less = slopes(narrow, 0.0, 0.05, 0.96, 5.0, np.nan, -0.5)
    assert np.allclose(20 * rising, full, rtol=1e-9)  # 0.005, then 0.1
    assert np.array_equal(full, more)
    assert np.array_equal(more, unknown)
    assert np.allclose(0.5 * unknown, less, rtol=1e-9)  # down to 0.05
    for down_m, held in ((1000.0, True), (0.01, False)):
        first, second = slopes(SUMMED, down_m, 1e-3, 1e-3)
        assert np.array_equal(first, second) == held
