"""Rotors, ground and battery round the rigid body, against closed forms and measured figures."""

from __future__ import annotations

import numpy as np
import pytest
from sim_hover import attitude, hovering, load, response

from offboard.model.frames import thrust_direction_from_quaternion
from simulator.vehicle.attitude import Demand
from simulator.vehicle.battery import Battery
from simulator.vehicle.conditions import Conditions
from simulator.vehicle.plant import Plant

PX4 = load("px4_sih")
G = PX4.gravity_mps2
LEVEL = attitude()


def _down_velocity(truth) -> float:
    return truth.velocity_ned_mps[2]


def _climbing(thrust: float, duration_s: float, **more) -> Plant:
    plant = Plant(PX4, Conditions(**more), 1)
    plant.advance(duration_s, Demand(True, thrust, LEVEL))
    return plant


# Measured on PX4: up .70, 1.72, 2.82 and down .82, 1.04, 2.89 m/s^2 for the same three steps
@pytest.mark.parametrize(("step", "measured"), [(0.05, 0.76), (0.20, 2.855)])
def test_thrust_step_on_px4_gives_the_measured_vertical_acceleration(step, measured):
    means = []
    for sign in (1.0, -1.0):
        demand = Demand(True, 0.489 + sign * step, LEVEL)
        _, down = response(hovering(PX4), demand, 0.6, _down_velocity)
        means.append(-sign * (down[124] - down[24]) / 0.4)  # 0.1 to 0.5 s
    assert np.mean(means) == pytest.approx(measured, rel=0.15)


# Measured on ArduCopter: mean vertical acceleration .3-.9 s after the step, with its drag
@pytest.mark.parametrize(("step", "measured"), [(-0.15, -3.45), (-0.05, -1.08), (0.15, 3.12)])
def test_thrust_step_on_arducopter_gives_the_measured_vertical_acceleration(step, measured):
    vehicle = load("arducopter")
    demand = Demand(True, vehicle.hover_thrust + step, LEVEL)
    times, down = response(hovering(vehicle), demand, 1.0, _down_velocity)
    at = np.interp([0.3, 0.9], times, down)
    assert -(at[1] - at[0]) / 0.6 == pytest.approx(measured, rel=0.12)


def test_thrust_follows_with_delay_and_first_order_lag():
    demand = Demand(True, 0.6, LEVEL)
    times, thrust = response(hovering(PX4), demand, 0.5, lambda t: t.thrust)
    start = PX4.hover_thrust
    share = (thrust - start) / (0.6 - start)
    expected = 1.0 - np.exp(-np.maximum(times - 0.015, 0.0) / 0.05)
    assert np.abs(share - expected).max() < 0.06  # one step of 4 ms on a lag of 50 ms
    assert share[-1] == pytest.approx(1.0, abs=1e-3)


def test_motors_off_in_the_air_is_free_fall_with_drag():
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
def test_vehicle_stays_on_the_ground_below_its_weight(share):
    tilted = attitude(roll_deg=15.0)
    plant = Plant(PX4, Conditions(wind_ned_mps=(4.0, -3.0, 0.0)), 1)
    plant.advance(5.0, Demand(True, share * PX4.hover_thrust, LEVEL))
    assert plant.truth.on_ground
    plant.advance(5.0, Demand(True, 0.5 * share * PX4.hover_thrust, tilted))
    truth = plant.truth
    assert truth.on_ground
    assert truth.position_ned_m[2] == 0.0
    assert truth.attitude == pytest.approx([1.0, 0.0, 0.0, 0.0], abs=1e-12)
    if share < 0.9:
        assert np.abs(truth.position_ned_m).max() < 1e-12
        assert np.abs(truth.velocity_ned_mps).max() < 1e-12


def test_crash_upside_down_at_speed_is_survived_and_ends_level():
    plant = _climbing(0.9, 4.0)
    plant.advance(0.8, Demand(True, 0.5, attitude(roll_deg=180.0, yaw_deg=40.0)))
    assert thrust_direction_from_quaternion(plant.truth.attitude)[2] < 0.0
    _, heights = response(plant, Demand(False), 6.0, lambda t: -t.position_ned_m[2])
    truth = plant.truth
    assert heights.max() > 5.0
    assert heights.min() == 0.0
    assert truth.on_ground
    assert thrust_direction_from_quaternion(truth.attitude) == pytest.approx([0, 0, 1], abs=1e-9)
    assert np.linalg.norm(truth.attitude) == pytest.approx(1.0, abs=1e-12)
    assert np.abs(truth.velocity_ned_mps).max() < 1e-12


def test_ground_effect_lifts_near_the_ground_only():
    share = 0.96  # of hover thrust: flies in ground effect and not without it
    assert not _climbing(share * PX4.hover_thrust, 2.0, ground_effect=True).truth.on_ground
    assert _climbing(share * PX4.hover_thrust, 2.0).truth.on_ground
    high = _climbing(share * PX4.hover_thrust, 60.0, ground_effect=True).truth
    assert 0.0 < -high.position_ned_m[2] < 0.3


def test_battery_empties_by_the_current_and_sags_under_load():
    battery = Battery(capacity_ah=1.0, hover_current_a=12.0, resistance_ohm=0.05)
    plant = Plant(PX4, Conditions(battery=battery), 1)
    full = plant.truth.battery
    assert (full.voltage_v, full.current_a, full.remaining) == pytest.approx((16.8, 0.0, 1.0))
    plant.advance(60.0, Demand(True, PX4.hover_thrust, LEVEL))
    used = plant.truth.battery
    assert used.current_a == pytest.approx(12.0, rel=1e-6)
    assert used.remaining == pytest.approx(1.0 - 12.0 * 60.0 / 3600.0, abs=1e-3)
    assert used.voltage_v == pytest.approx(4 * (3.5 + 0.7 * 0.8) - 0.05 * 12.0, abs=0.01)
    plant.advance(600.0, Demand(True, PX4.hover_thrust, LEVEL))
    assert plant.truth.battery.remaining == 0.0


def test_a_vehicle_of_almost_pure_drag_stays_finite():
    """Explicit integration of a drag of 1000 1/s at 4 ms would explode."""
    drag = {"drag_translation_npmps": (20.0,) * 3, "drag_rotation_nmpradps": (5.0,) * 3}
    feather = PX4.model_copy(update={"mass_kg": 0.02, "inertia_kgm2": (0.01,) * 3, **drag})
    plant = Plant(feather, Conditions(wind_ned_mps=(5.0, 0.0, 0.0)), 1)
    plant.advance(4.0, Demand(True, 0.9, attitude(roll_deg=20.0)))
    assert plant.truth.velocity_ned_mps[0] == pytest.approx(5.0, abs=0.1)
    assert np.isfinite(plant.truth.attitude).all()
