"""The attitude loop against the step responses measured on PX4 and ArduCopter, and its limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from sim_hover import attitude, crossing, estimate_of, euler_deg, hovering, load, response

from offboard.model.frames import euler_from_quaternion
from simulator.steps import STEP_S
from simulator.vehicle.attitude import Demand
from simulator.vehicle.conditions import Conditions

AXES = {"roll": 0, "pitch": 1, "yaw": 2}


# Measured figures; the slack covers their own spread and that telemetry at 100 Hz shows a
# crossing half a sample late. Times of 10, 63 and 90 % in s, peak in degrees
@pytest.mark.parametrize(
    ("vehicle", "axis", "step_deg", "t10", "t63", "t90", "peak"),
    [
        ("px4_sih", "roll", -10.0, (0.085, 0.105), (0.185, 0.21), (0.24, 0.265), (10.7, 11.3)),
        ("px4_sih", "pitch", 10.0, (0.085, 0.105), (0.185, 0.21), (0.24, 0.265), (10.7, 11.3)),
        ("px4_sih", "yaw", 30.0, (0.26, 0.31), (0.59, 0.64), (0.74, 0.80), (37.3, 38.7)),
        ("arducopter", "roll", 10.0, (0.05, 0.07), (0.185, 0.21), (0.35, 0.38), (9.95, 10.2)),
        ("arducopter", "yaw", 30.0, (0.19, 0.34), (0.57, 0.61), (0.70, 0.80), (33.2, 34.0)),
    ],
)
def test_attitude_step_has_the_measured_shape(vehicle, axis, step_deg, t10, t63, t90, peak):
    truth, angles = load(vehicle), [0.0, 0.0, 0.0]
    angles[AXES[axis]] = step_deg
    demand = Demand(True, truth.hover_thrust, attitude(*angles))
    times, euler = response(hovering(truth), demand, 5.0, euler_deg)
    share = euler[:, AXES[axis]] / step_deg
    assert t10[0] <= crossing(times, share, 0.1) <= t10[1]
    assert t63[0] <= crossing(times, share, 1.0 - math.exp(-1.0)) <= t63[1]
    assert t90[0] <= crossing(times, share, 0.9) <= t90[1]
    assert peak[0] <= share.max() * abs(step_deg) <= peak[1]
    assert share[-1] == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize(
    ("vehicle", "axis", "rate", "t63"),
    [
        ("px4_sih", "pitch", -0.6, (0.09, 0.125)),
        ("px4_sih", "yaw", 0.6, (0.43, 0.50)),
        ("arducopter", "pitch", 0.6, (0.035, 0.07)),
    ],
)
def test_rate_step_has_the_measured_rise(vehicle, axis, rate, t63):
    truth, rates = load(vehicle), [0.0, 0.0, 0.0]
    rates[AXES[axis]] = rate
    demand = Demand(True, truth.hover_thrust, rates_frd_radps=tuple(rates))
    times, values = response(hovering(truth), demand, 2.5, lambda t: t.rates_frd_radps)
    share = values[:, AXES[axis]] / rate
    assert t63[0] <= crossing(times, share, 1.0 - math.exp(-1.0)) <= t63[1]
    assert share[-1] == pytest.approx(1.0, abs=0.01)


def test_angular_acceleration_is_limited_on_a_large_step():
    vehicle = load("arducopter")
    demand = Demand(True, vehicle.hover_thrust, attitude(roll_deg=60.0))
    times, rates = response(hovering(vehicle), demand, 1.0, lambda t: t.rates_frd_radps[0])
    acceleration = np.diff(rates) / STEP_S
    limit = vehicle.angular_acceleration_limit_radps2[0]
    assert np.abs(acceleration).max() == pytest.approx(limit, rel=5e-3)
    assert np.sum(np.abs(acceleration) > 0.99 * limit) >= 10  # it is not grazed but sat on
    assert times[np.argmax(rates > 2.0)] > 2.0 / limit


def test_loop_closes_on_the_estimate_and_not_on_the_truth():
    vehicle = load("px4_sih")
    plant = hovering(vehicle, Conditions(estimator="px4_like"), seed=5)
    demand = Demand(True, vehicle.hover_thrust, attitude())
    true, estimated = [], []
    for _ in range(600):
        plant.advance(0.1, demand)
        true.append(euler_from_quaternion(plant.truth.attitude)[:2])
        estimated.append(euler_from_quaternion(estimate_of(plant).attitude)[:2])
    assert np.std(estimated, axis=0).max() < 0.006
    assert np.std(true, axis=0).min() > 0.012
