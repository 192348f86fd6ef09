"""Airframe: rotors, ground contact and battery charge around the rigid body.

The rigid body (mass, drag relative to the air) is in `offboard.model.rigid_body`. This module adds
what the controller's model does not have: rotor lag, loss of torque at low thrust, ground, consumed
charge. Compiled. Knows no autopilot, no estimate and no randomness.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import kernel
from offboard.model.rigid_body import pack, quaternion_into, rk4_into
from offboard.model.vehicle import Vehicle
from simulator.steps import STEP_S
from simulator.vehicle.conditions import Conditions

Array = NDArray[np.float64]

# Indices in the rotor state, which adds to the 13 states of the rigid body: actual normalised
# collective thrust; 1 while the ground carries the vehicle; consumed charge (A s); from 3 on the
# NED acceleration of the last step.
THRUST, CONTACT, CHARGE, ROTOR_SIZE = 0, 1, 2, 6

# Below this share of hover thrust the torques decrease with the thrust, to zero.
_AUTHORITY_SHARE = 0.2
# Landing gear: coefficient of friction, high enough that wind does not move a landed vehicle, and
# time constant of levelling.
_FRICTION = 1.5
_LEVELLING_TIME_S = 0.1
# Limit of decay rate times substep; the explicit Runge-Kutta method is stable up to 2.78.
_STIFFNESS_LIMIT = 0.5


def build_airframe(vehicle: Vehicle, conditions: Conditions) -> tuple[Array, Array, int]:
    """Constants of the simulated vehicle: those of the controller's model, with the factors of the
    conditions on thrust and mass.

    Returns:
        Constants of the body, as in `offboard.model.rigid_body.pack`; of the rotors: maximum thrust
        in N, factor by which the lag decays in a step, thrust above which torques are full, hover
        thrust, hover current in A; and the number of substeps of a step.
    """
    body = pack(vehicle, conditions.quadratic_drag_npmps2)
    lag_s = vehicle.thrust_lag_s
    rotor = np.array(
        [
            conditions.thrust_scale * vehicle.mass_kg * vehicle.thrust_max_mps2,
            math.exp(-STEP_S / lag_s) if lag_s > 0.0 else 0.0,
            _AUTHORITY_SHARE * vehicle.hover_thrust,
            vehicle.hover_thrust,
            conditions.battery.hover_current_a,
        ]
    )
    body[0] *= conditions.mass_scale
    stiffness = max(body[6:9].max() / body[0], (body[9:12] / body[2:5]).max())
    substeps = max(1, math.ceil(STEP_S * stiffness / _STIFFNESS_LIMIT))
    return body, rotor, substeps


@kernel
def advance_airframe(plant: Any, thrust_demand: float) -> None:
    """Advance body and rotor of a `simulator.vehicle.dynamics.RECORD` by one step, in place, with
    its angular acceleration `turn` and a thrust of 0 .. 1."""
    body, rotor, inputs = plant.body, plant.rotor, plant.inputs
    body_constants, rotor_constants = plant.body_constants, plant.rotor_constants
    before = rotor[THRUST]
    rotor[THRUST] = thrust_demand + (before - thrust_demand) * rotor_constants[1]
    mean = 0.5 * (before + rotor[THRUST])
    north, east, down = body[7], body[8], body[9]
    inputs[0] = rotor_constants[0] * mean
    # On the ground the vehicle does not rotate
    authority = 0.0 if rotor[CONTACT] > 0.5 else min(mean / rotor_constants[2], 1.0)
    _torques(body, plant.turn, authority, body_constants, inputs)
    part_s = STEP_S / plant.substeps
    for _ in range(plant.substeps):
        stands, stand_north, stand_east = rotor[CONTACT] > 0.5, body[10], body[11]
        rk4_into(
            quaternion_into,
            body[:],
            inputs,
            plant.wind,
            body_constants,
            part_s,
            plant.slopes,
            body[:],
        )
        rotor[CONTACT] = _touch_ground(body, part_s)
        if stands and rotor[CONTACT] > 0.5 and body[7] == 0.0 and body[8] == 0.0:
            body[10], body[11] = stand_north, stand_east  # held by friction
    rotor[3] = (body[7] - north) / STEP_S
    rotor[4] = (body[8] - east) / STEP_S
    rotor[5] = (body[9] - down) / STEP_S
    rotor[CHARGE] += rotor_constants[4] * (mean / rotor_constants[3]) ** 1.5 * STEP_S


@kernel
def _torques(body: Array, turn: Array, authority: float, constants: Array, inputs: Array) -> None:
    """Write the torque inputs 1 .. 3 for an angular acceleration, scaled by `authority`.

    The mixer is perfect. The inputs compensate the gyroscopic torque and the rotational drag, which
    the rigid body subtracts.
    """
    p, q, r = body[4], body[5], body[6]
    i_x, i_y, i_z, arm = constants[2], constants[3], constants[4], constants[5]
    roll = i_x * turn[0] + (i_z - i_y) * q * r + constants[9] * p
    pitch = i_y * turn[1] + (i_x - i_z) * r * p + constants[10] * q
    yaw = i_z * turn[2] + (i_y - i_x) * p * q + constants[11] * r
    inputs[1] = authority * roll / arm
    inputs[2] = authority * pitch / arm
    inputs[3] = authority * yaw


@kernel
def _touch_ground(body: Array, step_s: float) -> float:
    """Apply an inelastic ground at down = 0 with friction. Return 1 if it carries the vehicle, or
    0."""
    if body[12] < 0.0:
        return 0.0
    body[12] = 0.0
    if body[9] < 0.0:
        return 0.0
    # Coulomb: the horizontal impulse is at most the friction coefficient times the vertical one
    speed = math.hypot(body[7], body[8])
    grip = _FRICTION * body[9]
    left = (speed - grip) / speed if speed > grip else 0.0
    body[7] *= left
    body[8] *= left
    body[9] = 0.0
    body[4] = body[5] = body[6] = 0.0
    _set_level(body, 1.0 - math.exp(-step_s / _LEVELLING_TIME_S))
    return 1.0


@kernel
def _set_level(body: Array, share: float) -> None:
    """Reduce the tilt by this share of it; the heading does not change."""
    norm = math.hypot(body[0], body[3])
    w, z = (body[0] / norm, body[3] / norm) if norm > 1e-9 else (1.0, 0.0)
    body[0] += share * (w - body[0])
    body[1] -= share * body[1]
    body[2] -= share * body[2]
    body[3] += share * (z - body[3])
    length = math.sqrt(body[0] ** 2 + body[1] ** 2 + body[2] ** 2 + body[3] ** 2)
    for i in range(4):
        body[i] /= length
