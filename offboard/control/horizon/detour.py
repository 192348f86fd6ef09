"""Ways past keep-out volumes, for a search to begin with: beside each side of each volume.

A way is a sequence of states for the closed form to hold on to. None need be good: a search would
find better ones, but not the other side of a volume that is wider than its horizon reaches.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from offboard.control.horizon.keep_out import CENTRE, HALF, RADIUS, ROUND
from offboard.control.horizon.plant import STATE_SIZE, P, Scene, V, W, Z

Array = NDArray[np.float64]

NEAR_M = 1.0  # beyond what must be kept free: what is further off is no reason to go round
SIDES = ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0), (2, -1.0))  # axis NED and sign; never below
ROWS = ((P, V), (P + 1, V + 1), (Z, W))  # position and velocity of each axis in a state


def detours(scene: Scene, reach_m: float) -> list[Array]:
    """States (N + 1, STATE_SIZE) of every way past a volume less than `reach_m` and a bit away from
    the reference within the horizon."""
    ways = []
    places, speeds = scene.positions[::2], scene.velocities[::2]
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
