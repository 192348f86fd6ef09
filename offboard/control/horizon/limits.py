"""What a plan may not exceed, and what it pays where it does, compiled: speed, tilt, the ground and
volumes to keep out of. Knows no motion: states are given.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from offboard.control.horizon.keep_out import CENTRE, VELOCITY, distance
from offboard.control.horizon.plant import (
    CLEARANCE,
    HOLD,
    NONLINEAR,
    SPEED_MOST,
    TILT_MOST,
    B,
    P,
    V,
    W,
    Z,
)

# Limits of a hold; every volume is two, at the middle and at the end.
SPEED, TILT, FLOOR, VOLUME = range(4)

# What a violated limit costs a second: per metre (or m/s, or unit of b), and per its square.
SLOPE, CURVATURE = 20.0, 200.0


@numba.njit(cache=True)
def penalise(plant, scene, k, before, after, costs) -> None:  # type: ignore[no-untyped-def]
    """What hold k pays for the limits that it exceeds."""
    over = np.empty(costs.shape[0])
    for limit in range(limits_of(scene)):
        if _applies(plant, scene, limit):
            _exceed(plant, scene, k, limit, before, after, over)
            share = share_of(plant, limit)
            for n in range(costs.shape[0]):
                costs[n] += share * _excess(over[n])


@numba.njit(cache=True)
def excesses(plant, scene, states, over) -> None:  # type: ignore[no-untyped-def]
    """By how much plans exceed each limit in each hold, negative within, -inf where there is none:
    over (N * limits, particles) of states (N + 1, STATE_SIZE, particles)."""
    count = limits_of(scene)
    for k in range(states.shape[0] - 1):
        for limit in range(count):
            row = over[k * count + limit]
            row[:] = -math.inf
            if _applies(plant, scene, limit):
                _exceed(plant, scene, k, limit, states[k], states[k + 1], row)


@numba.njit(cache=True)
def limits_of(scene) -> int:  # type: ignore[no-untyped-def]
    """Limits of each hold: speed, tilt, floor, and every volume at its middle and its end."""
    return int(VOLUME + 2 * scene.volumes.shape[0])


@numba.njit(cache=True)
def share_of(plant, limit) -> float:  # type: ignore[no-untyped-def]
    """For how many seconds of a hold an excess is paid."""
    return float(plant.scalars[HOLD] * (0.5 if limit >= VOLUME else 1.0))


@numba.njit(cache=True)
def _applies(plant, scene, limit) -> bool:  # type: ignore[no-untyped-def]
    c = plant.scalars
    if limit == SPEED:
        return bool(c[SPEED_MOST] < math.inf)
    if limit == TILT:
        return bool(c[NONLINEAR] != 0.0)
    return bool(scene.volumes.shape[0] > 0)


@numba.njit(cache=True)
def _exceed(plant, scene, k, limit, before, after, over) -> None:  # type: ignore[no-untyped-def]
    """By how much (particles,) hold k exceeds a limit."""
    c = plant.scalars
    end = 2 * k + 2
    if limit == SPEED:
        v = scene.velocities[end]
        for n in range(over.shape[0]):
            north, east = v[0] + after[V, n], v[1] + after[V + 1, n]
            climb = v[2] + after[W, n]
            over[n] = math.sqrt(north * north + east * east + climb * climb) - c[SPEED_MOST]
    elif limit == TILT:
        b = scene.directions[end]
        for n in range(over.shape[0]):
            north, east = b[0] + after[B, n], b[1] + after[B + 1, n]
            over[n] = math.sqrt(north * north + east * east) - c[TILT_MOST]
    elif limit == FLOOR:
        room = max(scene.floor_down_m - scene.positions[end, 2], 0.0)
        for n in range(over.shape[0]):
            over[n] = after[Z, n] - room
    else:
        _intrude(plant, scene, (limit - VOLUME) // 2, end - limit % 2, before, after, over)


@numba.njit(cache=True)
def _intrude(plant, scene, i, node, before, after, over) -> None:  # type: ignore[no-untyped-def]
    """How deep (particles,) within the clearance of volume i at the middle or end of a hold."""
    c = plant.scalars
    hold = c[HOLD]
    volume = scene.volumes[i].copy()
    for axis in range(3):
        volume[CENTRE + axis] += 0.5 * hold * node * volume[VELOCITY + axis]
    at = scene.positions[node]
    bow = 0.125 * hold
    for n in range(over.shape[0]):
        if node % 2 == 0:
            x, y, z = after[P, n], after[P + 1, n], after[Z, n]
        else:  # halfway, as position and velocity at both ends have it
            x = 0.5 * (before[P, n] + after[P, n]) + bow * (before[V, n] - after[V, n])
            y = 0.5 * (before[P + 1, n] + after[P + 1, n])
            y += bow * (before[V + 1, n] - after[V + 1, n])
            z = 0.5 * (before[Z, n] + after[Z, n]) + bow * (before[W, n] - after[W, n])
        over[n] = c[CLEARANCE] - distance(volume, at[0] + x, at[1] + y, at[2] + z)


@numba.njit(cache=True)
def _excess(value: float) -> float:
    over = max(value, 0.0)
    return over * (SLOPE + CURVATURE * over)
