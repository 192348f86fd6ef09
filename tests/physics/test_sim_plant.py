"""The plant as a whole: determinism, time, and demands no sane flight stack would send."""

from __future__ import annotations

import math

import numpy as np
import pytest
from sim_hover import attitude, estimate_of, load

from simulator.steps import STEP_S
from simulator.vehicle.attitude import Demand
from simulator.vehicle.conditions import Conditions
from simulator.vehicle.plant import Plant

PX4 = load("px4_sih")
ROUGH = Conditions(
    estimator="px4_like",
    wind_ned_mps=(3.0, 1.0, 0.0),
    gusts={"intensity_mps": 1.5},
    ground_effect=True,
)


def _bytes(plant: Plant) -> bytes:
    """Truth and estimate."""
    names = ("position_ned_m", "velocity_ned_mps", "attitude", "rates_frd_radps")
    parts = [getattr(each, name) for each in (plant.truth, estimate_of(plant)) for name in names]
    return b"".join(part.tobytes() for part in (*parts, plant.truth.wind_ned_mps))


def _fly(seed: int, cut: int) -> bytes:
    plant = Plant(PX4, ROUGH, seed)
    for thrust, angles in ((0.7, (0, 0, 0)), (0.45, (8, -4, 30)), (0.5, (-8, 4, -30))):
        for _ in range(240 // cut):
            plant.advance(cut * STEP_S, Demand(True, thrust, attitude(*angles)))
    return _bytes(plant)


def test_gusts_reach_the_vehicle_on_all_axes_whatever_way_the_wind_blows():
    gusts = {"intensity_mps": 2.0, "vertical_ratio": 0.4, "length_m": 2.0, "vertical_length_m": 1.0}
    plant = Plant(PX4, Conditions(wind_ned_mps=(0.0, 6.0, 0.0), gusts=gusts), 5)
    winds = []
    for _ in range(8000):
        plant.advance(0.05, Demand(False))
        winds.append(plant.truth.wind_ned_mps)
    assert np.mean(winds, axis=0) == pytest.approx((0.0, 6.0, 0.0), abs=0.25)
    assert np.std(winds, axis=0) == pytest.approx((2.0, 2.0, 0.8), rel=0.06)
    correlation = np.corrcoef(np.transpose(winds)) - np.eye(3)
    assert np.abs(correlation).max() < 0.1


def test_same_seed_gives_the_same_bytes_however_time_is_cut():
    assert _fly(17, 1) == _fly(17, 24) == _fly(17, 240) != _fly(18, 240)


HOSTILE = [math.nan, math.inf, -math.inf, 0.0, -1.0, 1e300, -1e300, 1e-300, 1.5, 0.5]


def test_hostile_demands_never_make_anything_infinite():
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
