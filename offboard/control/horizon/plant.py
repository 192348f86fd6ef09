"""What roll-outs fly, as arrays for compiled code: the plant of one vehicle, the scene of one
decision, and where a state has what.

States and inputs are deviations from the reference (`Outlook`). Knows no cost and no search.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from offboard.control.horizon.outlook import Bounds, Outlook
from offboard.control.response import SHORTEST_THRUST_LAG_S, CostToGo
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]

# Rows of a state: position, velocity, b, b' north and east in turn; height, climb, T b_z; T.
P, V, B, R, Z, W, F, T = 0, 2, 4, 6, 8, 9, 10, 11
STATE_SIZE = 12
INPUTS = 3


class Plant(NamedTuple):
    """Constants of one vehicle and period, all (n,) or (n, n) float arrays."""

    lateral: Array  # (4, 4) transition
    lateral_input: Array  # (4,)
    vertical: Array  # (3, 3)
    vertical_input: Array  # (3,)
    tilt_half: Array  # (2, 3) b and b' after half a hold, of [b, b', input]
    lateral_stage: Array  # (5, 5)
    vertical_stage: Array  # (4, 4)
    lateral_terminal: Array  # (4, 4)
    vertical_terminal: Array  # (3, 3)
    lateral_gain: Array  # (4,)
    vertical_gain: Array  # (3,)
    scalars: Array  # below


# Indices of `Plant.scalars`.
GRAVITY, HOLD, LAG_HALF, LAG_FULL, THRUST_LEAST, THRUST_MOST, TILT_MOST, SPEED_MOST = range(8)
PUSH_V0, PUSH_V1, PUSH_V2, PUSH_P0, PUSH_P1, NONLINEAR, CLEARANCE = range(8, 15)
SCALARS = 15


def plant_of(
    vehicle: Vehicle,
    lateral: CostToGo,
    vertical: CostToGo,
    period_s: float,
    *,
    half: CostToGo,
    nonlinear: bool,
    thrust_mps2: tuple[float, float],
    speed_limit_mps: float,
    clearance_m: float,
) -> Plant:
    """`half` is the lateral model sampled at half the period."""
    lag_s = max(vehicle.thrust_lag_s, SHORTEST_THRUST_LAG_S)
    drag = vehicle.drag_per_mass_ps

    def carried(after_s: float) -> float:
        """Of a push, what is left as position after a time in drag, per unit."""
        return -math.expm1(-drag * after_s) / drag if drag > 0 else after_s

    scalars = np.empty(SCALARS)
    scalars[GRAVITY], scalars[HOLD] = vehicle.gravity_mps2, period_s
    scalars[LAG_HALF] = math.exp(-0.5 * period_s / lag_s)
    scalars[LAG_FULL] = math.exp(-period_s / lag_s)
    scalars[THRUST_LEAST], scalars[THRUST_MOST] = thrust_mps2
    scalars[TILT_MOST] = math.sin(vehicle.tilt_max_rad)
    scalars[SPEED_MOST] = speed_limit_mps
    scalars[PUSH_V0] = period_s / 6.0 * math.exp(-drag * period_s)
    scalars[PUSH_V1] = period_s / 1.5 * math.exp(-0.5 * drag * period_s)
    scalars[PUSH_V2] = period_s / 6.0
    scalars[PUSH_P0] = period_s / 6.0 * carried(period_s)
    scalars[PUSH_P1] = period_s / 1.5 * carried(0.5 * period_s)
    scalars[NONLINEAR] = float(nonlinear)
    scalars[CLEARANCE] = clearance_m
    return Plant(
        *(np.ascontiguousarray(part) for part in (
            lateral.transition, lateral.input_map[:, 0],
            vertical.transition, vertical.input_map[:, 0],
            np.column_stack((half.transition[2:, 2:], half.input_map[2:, 0])),
            lateral.stage, vertical.stage, lateral.terminal, vertical.terminal,
            lateral.gain, vertical.gain, scalars,
        )),
    )  # fmt: skip


class Scene(NamedTuple):
    """What one decision is made in: the outlook, the bounds and the volumes, as arrays."""

    positions: Array  # (2 N + 1, 3)
    velocities: Array
    directions: Array
    thrusts_tilt: Array  # (2 N + 1,)
    thrusts_heave: Array
    uprights: Array
    feedforward: Array  # (N,): of the vertical thrust
    lower: Array  # (N, 3)
    upper: Array
    volumes: Array  # (V, PACKED_SIZE), where they are at the first node
    thrust_share: float  # of the thrust believed, what is there, by the vertical disturbance
    floor_down_m: float  # no way round a volume leads below, where the reference does not


def scene_of(outlook: Outlook, within: Bounds, volumes: Array, floor_down_m: float) -> Scene:
    """All that a roll-out reads: an outlook (N steps), input bounds, volumes (K, columns of
    `keep_out`), and the ground (m, NED down)."""
    return Scene(
        outlook.positions_ned_m,
        outlook.velocities_ned_mps,
        outlook.directions_ned,
        outlook.thrusts_tilt_mps2,
        outlook.thrusts_heave_mps2,
        outlook.uprights_heave,
        np.ascontiguousarray(outlook.feedforward[:, 2]),
        within.lower,
        within.upper,
        volumes,
        outlook.thrust_share,
        floor_down_m,
    )


def start_state(lateral: Array, vertical: Array, scene: Scene) -> Array:
    """(STATE_SIZE,) of the deviations lateral (4, 2) and vertical (3,) of `tracking.errors`."""
    start = np.empty(STATE_SIZE)
    start[P:Z] = lateral.reshape(-1)
    start[Z:T] = vertical
    b_n, b_e = scene.directions[0, :2]
    leant = upright(b_n + start[B], b_e + start[B + 1]) - upright(b_n, b_e)
    force = scene.thrusts_heave[0] * scene.uprights[0] + start[F]
    start[T] = force / (scene.uprights[0] + leant) - scene.thrusts_heave[0]
    return start


@numba.njit(cache=True)
def upright(north: float, east: float) -> float:
    """Down component of a thrust direction, a unit vector, by the other two (NED)."""
    return math.sqrt(max(1.0 - north * north - east * east, 0.01))
