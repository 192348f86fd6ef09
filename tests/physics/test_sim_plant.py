"""The simulated vehicle: attitude loop, rotors, ground and battery against measured responses and
closed forms; determinism, steps of time, and demands that are not finite or out of range."""

from __future__ import annotations

import math

import numpy as np
import pytest
from sim_hover import attitude, crossing, estimate_of, euler_deg, hovering, response

from offboard.model.frames import euler_from_quaternion, thrust_direction_from_quaternion
from simulator.config import scenario
from simulator.config import vehicle as load
from simulator.steps import STEP_S
from simulator.vehicle.attitude import Demand
from simulator.vehicle.conditions import Battery, Conditions
from simulator.vehicle.plant import Plant

AXES = {"roll": 0, "pitch": 1, "yaw": 2}


# Ranges about measured figures: they cover the spread, and that telemetry at 100 Hz shows a
# crossing half a sample late. Times of 10, 63 and 90 % in s, peak in degrees
ANGLES = [
    ("px4_sih", "roll", -10.0, (0.085, 0.105), (0.185, 0.21), (0.24, 0.265), (10.7, 11.3)),
    ("px4_sih", "pitch", 10.0, (0.085, 0.105), (0.185, 0.21), (0.24, 0.265), (10.7, 11.3)),
    ("px4_sih", "yaw", 30.0, (0.26, 0.31), (0.59, 0.64), (0.74, 0.80), (37.3, 38.7)),
    ("arducopter", "roll", 10.0, (0.05, 0.07), (0.185, 0.21), (0.35, 0.38), (9.95, 10.2)),
    ("arducopter", "yaw", 30.0, (0.19, 0.34), (0.57, 0.61), (0.70, 0.80), (33.2, 34.0)),
]
# Steps of a body rate in rad/s, time of 63 % in s
RATES = [
    ("px4_sih", "pitch", -0.6, (0.09, 0.125)),
    ("px4_sih", "yaw", 0.6, (0.43, 0.50)),
    ("arducopter", "pitch", 0.6, (0.035, 0.07)),
]


@pytest.mark.parametrize(("vehicle", "axis", "step_deg", "t10", "t63", "t90", "peak"), ANGLES)
def test_attitude_step_has_the_measured_shape(vehicle, axis, step_deg, t10, t63, t90, peak):
    truth, angles = load(vehicle), [0.0, 0.0, 0.0]
    angles[AXES[axis]] = step_deg
    demand = Demand(True, truth.hover_thrust, attitude(*angles))
    times, euler = response(hovering(truth), demand, 5.0, euler_deg)
    share = euler[:, AXES[axis]] / step_deg
    for level, (low, high) in ((0.1, t10), (1.0 - math.exp(-1.0), t63), (0.9, t90)):
        assert low <= crossing(times, share, level) <= high, level
    assert peak[0] <= share.max() * abs(step_deg) <= peak[1]
    assert share[-1] == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize(("vehicle", "axis", "rate", "t63"), RATES)
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
    assert np.sum(np.abs(acceleration) > 0.99 * limit) >= 10  # the limit is held, not only reached
    assert times[np.argmax(rates > 2.0)] > 2.0 / limit


def test_attitude_loop_controls_the_estimated_attitude():
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


PX4 = load("px4_sih")
G = PX4.gravity_mps2
LEVEL = attitude()


def _down_velocity(truth) -> float:
    return truth.velocity_ned_mps[2]


# Mean upward acceleration in m/s^2 from `begin_s` to `end_s` after a step of the thrust. PX4: mean
# of the steps up and down; ArduCopter: including its drag
@pytest.mark.parametrize(
    ("name", "step", "measured", "begin_s", "end_s", "near"),
    [
        ("px4_sih", 0.20, 2.855, 0.1, 0.5, 0.15),
        ("px4_sih", -0.20, -2.855, 0.1, 0.5, 0.15),
        ("arducopter", -0.15, -3.45, 0.3, 0.9, 0.12),
        ("arducopter", 0.15, 3.12, 0.3, 0.9, 0.12),
    ],
)
def test_thrust_step_gives_the_measured_acceleration(name, step, measured, begin_s, end_s, near):
    vehicle = load(name)
    demand = Demand(True, vehicle.hover_thrust + step, LEVEL)
    times, down = response(hovering(vehicle), demand, 1.0, _down_velocity)
    begin, end = np.interp([begin_s, end_s], times, down)
    assert (begin - end) / (end_s - begin_s) == pytest.approx(measured, rel=near)


@pytest.mark.parametrize("wind_ned_mps", [(8.0, 0.0, 0.0), (-5.7, 5.7, 0.0)])
def test_ardupilots_drag_grows_with_the_speed_along_each_body_axis(wind_ned_mps):
    """Specific force of ArduCopter 4.6 SITL on circles of 8 m/s: 0.246 u + 0.034 u |u| m/s^2 on
    each body axis, within 0.013; with the speed |v| in place of |u| within 0.18."""
    vehicle, flown = load("arducopter"), scenario("ardupilot_sitl").conditions
    plant = Plant(vehicle, flown.model_copy(update={"wind_ned_mps": wind_ned_mps}), 1)
    plant.advance(0.5, Demand(True, 1.4 * vehicle.hover_thrust, LEVEL))
    past = np.subtract(wind_ned_mps, plant.truth.velocity_ned_mps)[:2]
    measured = 0.246 * past + 0.034 * past * np.abs(past)
    assert plant.truth.acceleration_ned_mps2[:2] == pytest.approx(measured, rel=0.12)


def test_thrust_follows_with_delay_and_first_order_lag():
    demand = Demand(True, 0.6, LEVEL)
    times, thrust = response(hovering(PX4), demand, 0.5, lambda t: t.thrust)
    start = PX4.hover_thrust
    share = (thrust - start) / (0.6 - start)
    expected = 1.0 - np.exp(-np.maximum(times - 0.015, 0.0) / 0.05)
    assert np.abs(share - expected).max() < 0.06  # one step of 4 ms on a lag of 50 ms
    assert share[-1] == pytest.approx(1.0, abs=1e-3)


def test_vehicle_with_motors_off_falls_with_drag():
    plant = hovering(PX4)
    times, down = response(plant, Demand(False), 0.6, _down_velocity)
    rate = PX4.drag_translation_npmps[2] / PX4.mass_kg
    # the rotors run down with their lag: thrust g exp(-t/lag)
    decay = np.exp(-times / PX4.thrust_lag_s)
    still = np.exp(-rate * times)
    expected = G * (1 - still) / rate - G * (decay - still) / (rate - 1 / PX4.thrust_lag_s)
    assert np.abs(down - expected).max() < 0.02
    assert down[-1] > 3.4  # PX4, zero thrust: 3.4 m/s after 0.6 s from the command


@pytest.mark.parametrize("share", [0.5, 0.98])
def test_thrust_below_the_weight_does_not_lift_off(share):
    tilted = attitude(roll_deg=15.0)
    plant = Plant(PX4, Conditions(wind_ned_mps=(4.0, -3.0, 0.0)), 1)
    plant.advance(5.0, Demand(True, share * PX4.hover_thrust, LEVEL))
    assert plant.on_ground
    plant.advance(5.0, Demand(True, 0.5 * share * PX4.hover_thrust, tilted))
    truth = plant.truth
    assert plant.on_ground
    assert truth.position_ned_m[2] == 0.0
    assert truth.attitude == pytest.approx([1.0, 0.0, 0.0, 0.0], abs=1e-12)
    if share < 0.9:
        assert np.abs(truth.position_ned_m).max() < 1e-12
        assert np.abs(truth.velocity_ned_mps).max() < 1e-12


def test_vehicle_comes_to_rest_level_after_an_inverted_crash():
    plant = Plant(PX4, Conditions(), 1)
    plant.advance(4.0, Demand(True, 0.9, LEVEL))
    plant.advance(0.8, Demand(True, 0.5, attitude(roll_deg=180.0, yaw_deg=40.0)))
    assert thrust_direction_from_quaternion(plant.truth.attitude)[2] < 0.0
    _, heights = response(plant, Demand(False), 6.0, lambda t: -t.position_ned_m[2])
    truth = plant.truth
    assert heights.max() > 5.0
    assert heights.min() == 0.0
    assert plant.on_ground
    assert thrust_direction_from_quaternion(truth.attitude) == pytest.approx([0, 0, 1], abs=1e-9)
    assert np.linalg.norm(truth.attitude) == pytest.approx(1.0, abs=1e-12)
    assert np.abs(truth.velocity_ned_mps).max() < 1e-12


def test_battery_discharges_and_sags_under_load():
    battery = Battery(capacity_ah=1.0, hover_current_a=12.0, resistance_ohm=0.05)
    plant = Plant(PX4, Conditions(battery=battery), 1)
    full = plant.battery
    assert (full.voltage_v, full.current_a, full.remaining) == pytest.approx((16.8, 0.0, 1.0))
    plant.advance(60.0, Demand(True, PX4.hover_thrust, LEVEL))
    used = plant.battery
    assert used.current_a == pytest.approx(12.0, rel=1e-6)
    assert used.remaining == pytest.approx(1.0 - 12.0 * 60.0 / 3600.0, abs=1e-3)
    assert used.voltage_v == pytest.approx(4 * (3.5 + 0.7 * 0.8) - 0.05 * 12.0, abs=0.01)
    plant.advance(600.0, Demand(True, PX4.hover_thrust, LEVEL))
    assert plant.battery.remaining == 0.0


def test_vehicle_with_very_high_drag_stays_finite():
    """Explicit integration of a drag of 1000 1/s in steps of 4 ms would diverge."""
    drag = {"drag_translation_npmps": (20.0,) * 3, "drag_rotation_nmpradps": (5.0,) * 3}
    feather = PX4.model_copy(update={"mass_kg": 0.02, "inertia_kgm2": (0.01,) * 3, **drag})
    plant = Plant(feather, Conditions(wind_ned_mps=(5.0, 0.0, 0.0)), 1)
    plant.advance(4.0, Demand(True, 0.9, attitude(roll_deg=20.0)))
    assert plant.truth.velocity_ned_mps[0] == pytest.approx(5.0, abs=0.1)
    assert np.isfinite(plant.truth.attitude).all()


ROUGH = Conditions(
    estimator="px4_like",
    wind_ned_mps=(3.0, 1.0, 0.0),
    gusts={"intensity_mps": 1.5},
)


def _fly(seed: int, cut: int) -> bytes:
    plant = Plant(PX4, ROUGH, seed)
    for thrust, angles in ((0.7, (0, 0, 0)), (0.45, (8, -4, 30)), (0.5, (-8, 4, -30))):
        for _ in range(240 // cut):
            plant.advance(cut * STEP_S, Demand(True, thrust, attitude(*angles)))
    return plant.report().tobytes() + plant.wind_ned_mps.tobytes()


def test_same_seed_gives_the_same_bytes_for_any_time_slicing():
    assert _fly(17, 1) == _fly(17, 24) == _fly(17, 240) != _fly(18, 240)


HOSTILE = [math.nan, math.inf, -math.inf, 0.0, -1.0, 1e300, -1e300, 1e-300, 1.5, 0.5]


def test_invalid_demands_keep_the_state_finite():
    generator = np.random.default_rng(42)
    plant = Plant(PX4, ROUGH, 1)
    for _ in range(30_000):
        hostile = generator.random() < 0.5
        values = generator.choice(HOSTILE, 8) if hostile else generator.normal(0.0, 2.0, 8)
        kind = generator.integers(3)
        demand = Demand(
            motors_on=bool(generator.random() < 0.9),
            thrust=float(values[7]) if hostile else float(generator.random()),
            attitude=tuple(values[:4].tolist()) if kind == 0 else None,
            rates_frd_radps=tuple(values[4:7].tolist()) if kind == 1 else None,
        )
        plant.advance(STEP_S * int(generator.integers(1, 4)), demand)
        if not np.isfinite(plant._body).all():
            break
    truth, estimate = plant.truth, estimate_of(plant)
    for part in (truth.position_ned_m, truth.velocity_ned_mps, truth.acceleration_ned_mps2):
        assert np.isfinite(part).all()
    assert np.linalg.norm(truth.velocity_ned_mps) < 100.0
    assert np.linalg.norm(truth.attitude) == pytest.approx(1.0, abs=1e-9)
    assert np.linalg.norm(estimate.attitude) == pytest.approx(1.0, abs=1e-9)
    assert np.abs(truth.rates_frd_radps).max() < 20.0
    assert truth.position_ned_m[2] <= 0.0
