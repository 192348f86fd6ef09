"""The integral term and the state limits of the paper's law, in closed loop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from offboard.control.base import Situation
from offboard.control.swarm import certify
from offboard.model.command import Command
from offboard.model.predicted_state import PredictedState
from offboard.paper.integral import ErrorIntegral, IntegralSettings
from offboard.paper.law import PaperLaw, PaperSettings
from offboard.paper.plant import PlantKind, paper_model
from offboard.paper.state_limits import LimitedBox, StateLimits
from offboard.paper.study import extensions
from offboard.paper.study.closed_loop import FlightTask, fly
from offboard.reference.base import FlatSample
from offboard.run.configuration import load

Array = NDArray[np.float64]

STEADY = extensions.steady_tasks()
BOX = np.array(PaperSettings().lower), np.array(PaperSettings().upper)
TIGHT = StateLimits(
    tilt_rad=0.2, tilt_rate_radps=0.3, yaw_rate_radps=0.5, speed_mps=1.2, climb_mps=0.4
)


@pytest.mark.parametrize("plant", PlantKind)
@pytest.mark.parametrize("case", extensions.CASES)
def test_integral_removes_the_steady_error(plant: PlantKind, case: str) -> None:
    steady = {
        law: extensions.steady_error_m(fly(STEADY[law, case, plant])) for law in extensions.LAWS
    }
    assert steady["integral"] < 1e-3
    assert steady["Eqs. 33-35"] > 0.1
    assert steady["position weights raised"] > 0.1  # it is the integral, not the weights


def test_flight_and_study_fly_the_same_integral_law() -> None:
    law = load("paper", choices={"controller": "paper_integral"}).controller
    assert (law.fitness, law.integral) == (
        extensions.INTEGRAL.fitness,
        extensions.INTEGRAL.integral,
    )


def test_flight_and_study_fly_the_same_limits() -> None:
    law = load("paper", choices={"controller": "paper_limited"}).controller
    assert law.limits.margin >= extensions.MARGIN
    assert law.limits.model_copy(update={"margin": 0.0}) == extensions.LIMITS


def test_integral_sums_holds_and_stays_within_its_limits() -> None:
    integral = ErrorIntegral(IntegralSettings(limits=(1.0, 1.0, 1.0, 1.0)), 0.1)
    np.testing.assert_allclose(integral.add(np.array([1.0, -2.0, 0.0, 0.5])), [0.1, -0.2, 0, 0.05])
    np.testing.assert_allclose(integral.add(np.ones(4), held=True), [0.1, -0.2, 0, 0.05])
    np.testing.assert_allclose(integral.add(np.full(4, np.nan)), [0.1, -0.2, 0, 0.05])
    np.testing.assert_allclose(integral.add(np.array([1e3, -1e3, 0, 0])), [1, -1, 0, 0.05])
    integral.reset()
    np.testing.assert_array_equal(integral.value, np.zeros(4))


def test_no_sum_no_difference() -> None:
    plain = PaperLaw(*paper_model(), extensions.RAISED)
    unweighted = extensions.RAISED.model_copy(
        update={"integral": IntegralSettings(weights=(0.0, 0.0, 0.0, 0.0))}
    )
    other = PaperLaw(*paper_model(), unweighted)
    state = np.random.default_rng(3).normal(size=12)
    moves = [law.move(state, np.zeros(12)) for law in (plain, other)]
    np.testing.assert_allclose(moves[0].inputs, moves[1].inputs, atol=1e-7)
    np.testing.assert_allclose(moves[0].following, moves[1].following, atol=1e-8)


@pytest.mark.parametrize("plant", PlantKind)
def test_limits_hold_in_every_sample_of_the_tour(plant: PlantKind) -> None:
    tasks = extensions.limit_tasks()
    free, limited = (
        extensions.limited_states(fly(tasks[name, plant]), plant) for name in ("free", "limited")
    )
    for key, values in limited.items():
        assert values.max() <= getattr(extensions.LIMITS, key) * (1 + 1e-9), key
    assert free["tilt_rad"].max() > 1.2 * extensions.LIMITS.tilt_rad
    assert free["speed_mps"].max() > 1.2 * extensions.LIMITS.speed_mps
    assert limited["speed_mps"].max() > 0.9 * extensions.LIMITS.speed_mps  # used, not shunned


def test_limits_hold_whatever_is_done_within_the_narrowed_box() -> None:
    """Bang-bang by chance: the corner of the box, drawn anew now and then, for 3000 steps."""
    dynamics, inputs = paper_model()
    box = LimitedBox(dynamics, inputs, TIGHT, *BOX)
    rng = np.random.default_rng(1)
    state, corner, greatest = np.zeros(12), np.zeros(4), np.zeros(12)
    for k in range(3000):
        if k % 7 == 0:
            corner = rng.choice([0.0, 1.0], 4)
        lower, upper = box.narrow(state)
        assert (lower <= upper).all()
        state = dynamics @ state + inputs @ (lower + corner * (upper - lower))
        greatest = np.maximum(greatest, np.abs(state))
    for index, limit in TIGHT.per_state().items():
        assert greatest[index] <= limit * (1 + 1e-9)
        assert greatest[index] > 0.9 * limit


def test_outside_the_limits_the_vehicle_brakes_and_comes_back() -> None:
    dynamics, inputs = paper_model()
    box = LimitedBox(dynamics, inputs, TIGHT, *BOX)
    state = np.zeros(12)
    state[6] = 2.0 * TIGHT.speed_mps  # a gust
    for _ in range(60):
        lower, upper = box.narrow(state)
        assert (lower <= upper).all()
        state = dynamics @ state + inputs @ lower
    assert abs(state[6]) <= TIGHT.speed_mps


def test_the_certificate_is_of_the_narrowed_box() -> None:
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


class Point:
    """A reference at rest in a point."""

    duration_s = 1e6

    def __init__(self, position_ned_m: Array) -> None:
        self._position = position_ned_m

    def sample(self, time_s: float | Array) -> FlatSample:
        still, zero = np.zeros(3), np.float64(0.0)
        return FlatSample(self._position, still, still, still, still, zero, zero, zero)


def body_z(roll: float, pitch: float) -> Array:
    """The axis in NED, at course 0."""
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
        situation = Situation(0.1 * tick, state, Point(target_ned_m), command)
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
    limits = extensions.LIMITS
    _, fast, steep = flown_over_an_attitude_loop("paper", far, np.zeros(3), 20.0)
    _, slow, level = flown_over_an_attitude_loop("paper_limited", far, np.zeros(3), 20.0)
    assert np.abs(fast[:, :2]).max() > limits.speed_mps
    assert np.abs(slow[:, :2]).max() <= limits.speed_mps
    assert np.abs(slow[:, 2]).max() <= limits.climb_mps
    tilts = np.abs([np.arcsin(level[:, 1]), np.arctan2(level[:, 0], level[:, 2])])
    assert tilts.max() <= limits.tilt_rad
    assert np.abs(np.arctan2(steep[:, 0], steep[:, 2])).max() > limits.tilt_rad


def test_wrong_thrust_does_not_upset_the_limits() -> None:
    settings = PaperSettings(limits=extensions.LIMITS.model_copy(update={"margin": 0.1}))
    task = replace(FlightTask(settings, PlantKind.NONLINEAR, steps=400), thrust_loss=0.05)
    reached = extensions.limited_states(fly(task), PlantKind.NONLINEAR)
    assert reached["tilt_rad"].max() <= extensions.LIMITS.tilt_rad
    assert reached["speed_mps"].max() <= extensions.LIMITS.speed_mps
