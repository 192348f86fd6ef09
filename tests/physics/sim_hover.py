"""Flights for tests of the simulated vehicle: a settled hover, the response to a demand."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np

from offboard.model.frames import euler_from_quaternion, quaternion_from_euler
from offboard.model.vehicle import Vehicle
from simulator.steps import STEP_S
from simulator.vehicle.attitude import Demand
from simulator.vehicle.conditions import Conditions
from simulator.vehicle.plant import Plant
from simulator.vehicle.sensors import ATTITUDE, POSITION, RATES, VELOCITY

CALM = Conditions()


def attitude(roll_deg: float = 0.0, pitch_deg: float = 0.0, yaw_deg: float = 0.0):
    angles = [math.radians(angle) for angle in (roll_deg, pitch_deg, yaw_deg)]
    return tuple(quaternion_from_euler(*angles))


def hovering(vehicle: Vehicle, conditions: Conditions = CALM, seed: int = 1) -> Plant:
    """A level hover at some metres, nose north. In calm air its true speed is 1 mm/s at most."""
    plant = Plant(vehicle, conditions, seed)
    plant.advance(1.5, Demand(True, 1.4 * vehicle.hover_thrust, attitude()))
    for _ in range(500):
        down = plant.truth.velocity_ned_mps[2]
        thrust = vehicle.hover_thrust * (1.0 + 0.2 * down)
        plant.advance(0.02, Demand(True, thrust, attitude()))
    return plant


def estimate_of(plant: Plant) -> SimpleNamespace:
    """Return the estimate, with names as in `Truth`."""
    seen = plant.report().copy()
    return SimpleNamespace(
        position_ned_m=seen[POSITION],
        velocity_ned_mps=seen[VELOCITY],
        attitude=seen[ATTITUDE],
        rates_frd_radps=seen[RATES],
    )


def response(plant: Plant, demand: Demand, duration_s: float, read) -> tuple:
    """Times since the demand in s, and `read(truth)` at every step."""
    values = []
    for _ in range(round(duration_s / STEP_S)):
        plant.advance(STEP_S, demand)
        values.append(read(plant.truth))
    return np.arange(1, len(values) + 1) * STEP_S, np.array(values)


def euler_deg(truth) -> np.ndarray:
    return np.degrees(euler_from_quaternion(truth.attitude))


def crossing(times, values, level: float) -> float:
    """Return the first time at which the response exceeds `level` (interpolated)."""
    i = int(np.argmax(values > level))
    before = values[i - 1] if i else 0.0
    start = times[i - 1] if i else 0.0
    return start + (times[i] - start) * (level - before) / (values[i] - before)
