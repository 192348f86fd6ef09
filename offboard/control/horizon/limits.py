"""Soft limits of a plan, compiled: speed, tilt, the ground and keep-out volumes. Exceeding them is
penalised.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import array, entry, kernel
from offboard.control.horizon.keep_out import CENTRE, VELOCITY, distance
from offboard.control.horizon.plant import PLANT, SCENE, B, P, V, W, Z

Array = NDArray[np.float64]

# Limits of a hold; every volume counts twice, at the middle and at the end
SPEED, TILT, FLOOR, VOLUME = range(4)

# Penalty of an exceeded limit per second: per metre (or m/s, or unit of b), and per its square
SLOPE, CURVATURE = 20.0, 200.0


@kernel
def penalise(hold_s: float, limit: int, over: Array, costs: Array) -> None:
    """Add the penalties of one hold to costs (particles,), for exceeding a limit by `over`."""
    share = share_of(hold_s, limit)
    for n in range(costs.shape[0]):
        costs[n] += share * _excess(over[n])


@entry(PLANT, SCENE, array(2), array(3), array(2))
def excesses(plants: Any, scenes: Any, volumes: Array, states: Array, over: Array) -> None:
    """Compute by how much plans exceed each limit in each hold: over (N * limits, particles) of
    states (N + 1, STATE_SIZE, particles). Negative within a limit, -inf where it does not apply."""
    plant, scene = plants[0], scenes[0]
    count = limits_of(volumes)
    for k in range(states.shape[0] - 1):
        for limit in range(count):
            row = over[k * count + limit]
            row[:] = -math.inf
            if applies(plant, volumes, limit):
                exceed(plant, scene, volumes, k, limit, states[k], states[k + 1], row)


@kernel
def limits_of(volumes: Array) -> int:
    """Number of limits in each hold: speed, tilt, floor, and two for every volume."""
    return int(VOLUME + 2 * volumes.shape[0])


@kernel
def share_of(hold_s: float, limit: int) -> float:
    """The seconds of a hold for which an excess is penalised."""
    return float(hold_s * (0.5 if limit >= VOLUME else 1.0))


@kernel
def applies(plant: Any, volumes: Array, limit: int) -> bool:
    """Whether this limit applies to the plant and the situation."""
    if limit == SPEED:
        return bool(plant.speed_most_mps < math.inf)
    if limit == TILT:
        return bool(plant.nonlinear != 0)
    return bool(volumes.shape[0] > 0)


@kernel
def exceed(
    plant: Any,
    scene: Any,
    volumes: Array,
    k: int,
    limit: int,
    before: Array,
    after: Array,
    over: Array,
) -> None:
    """Compute by how much hold k exceeds a limit, over (particles,)."""
    end = 2 * k + 2
    if limit == SPEED:
        v = scene.velocities[end]
        for n in range(over.shape[0]):
            north, east = v[0] + after[V, n], v[1] + after[V + 1, n]
            climb = v[2] + after[W, n]
            over[n] = math.sqrt(north * north + east * east + climb * climb) - plant.speed_most_mps
    elif limit == TILT:
        b = scene.directions[end]
        for n in range(over.shape[0]):
            north, east = b[0] + after[B, n], b[1] + after[B + 1, n]
            over[n] = math.sqrt(north * north + east * east) - plant.tilt_most
    elif limit == FLOOR:
        room = max(scene.floor_down_m - scene.positions[end, 2], 0.0)
        for n in range(over.shape[0]):
            over[n] = after[Z, n] - room
    else:
        volume, node = volumes[(limit - VOLUME) // 2], end - limit % 2
        _intrude(plant, scene, volume, node, before, after, over)


@kernel
def _intrude(
    plant: Any, scene: Any, volume: Array, node: int, before: Array, after: Array, over: Array
) -> None:
    """Compute how deep particles are in the clearance of a volume, in the middle or at the end of
    a hold."""
    hold = plant.hold_s
    centre_n = volume[CENTRE] + 0.5 * hold * node * volume[VELOCITY]
    centre_e = volume[CENTRE + 1] + 0.5 * hold * node * volume[VELOCITY + 1]
    centre_d = volume[CENTRE + 2] + 0.5 * hold * node * volume[VELOCITY + 2]
    at = scene.positions[node]
    bow = 0.125 * hold
    for n in range(over.shape[0]):
        if node % 2 == 0:
            x, y, z = after[P, n], after[P + 1, n], after[Z, n]
        else:  # the middle, from position and velocity at both ends
            x = 0.5 * (before[P, n] + after[P, n]) + bow * (before[V, n] - after[V, n])
            y = 0.5 * (before[P + 1, n] + after[P + 1, n])
            y += bow * (before[V + 1, n] - after[V + 1, n])
            z = 0.5 * (before[Z, n] + after[Z, n]) + bow * (before[W, n] - after[W, n])
        away = distance(volume, centre_n, centre_e, centre_d, at[0] + x, at[1] + y, at[2] + z)
        over[n] = plant.clearance_m - away


@kernel
def _excess(value: float) -> float:
    over = max(value, 0.0)
    return over * (SLOPE + CURVATURE * over)
