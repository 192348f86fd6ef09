"""Detours round keep-out volumes, as starts of a search: one past each side of each volume.

A detour is a sequence of states that the closed form follows. It need not be good: the search
improves it. But the search alone would not find the other side of a wide volume.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from offboard.control.horizon.keep_out import CENTRE, HALF, RADIUS, ROUND
from offboard.control.horizon.plant import STATE_SIZE, P, Scene, V, W, Z

Array = NDArray[np.float64]

NEAR_M = 1.0  # volumes whose clearance is further from the reference need no detour
# Axis NED and sign: a detour never passes below a volume
SIDES = ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0), (2, -1.0))
ROWS = ((P, V), (P + 1, V + 1), (Z, W))  # position and velocity of each axis in a state


def detours(scene: Scene, reach_m: float) -> list[Array]:
    """States (N + 1, STATE_SIZE) of all detours round the volumes that are near the reference;
    `reach_m` is the distance to keep from their surface."""
    ways = []
    places, speeds = scene.ahead.positions_ned_m[::2], scene.ahead.velocities_ned_mps[::2]
    for volume in scene.volumes:
        half = volume[HALF : HALF + 3] + volume[ROUND]
        half[:2] += volume[RADIUS]
        centre = volume[CENTRE : CENTRE + 3]
        off = np.abs(places - centre) - half - reach_m
        if not bool((off < NEAR_M).all(axis=1).any()):
            continue
        for axis, sign in SIDES:
            way = np.zeros((len(places), STATE_SIZE))
            beside = centre[axis] + sign * (half[axis] + reach_m)
            past = sign * (beside - places[:, axis]) > 0.0
            position, velocity = ROWS[axis]
            way[past, position] = beside - places[past, axis]
            way[past, velocity] = -speeds[past, axis]
            ways.append(way)
    return ways
