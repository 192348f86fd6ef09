"""Wind: steady wind and Dryden gusts (MIL-F-8785C) that pass the vehicle at a fixed speed.

This module makes the matrices of the process; the plant advances it. Knows no vehicle.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from offboard.documents.parameters import Parameters
from simulator.vehicle.noise import LinearProcess, block_diagonal, discretise

Array = NDArray[np.float64]

GUST_COUNT = 5
"""States of the gust process."""


class Gusts(Parameters):
    """Dryden turbulence. Standard deviations in m/s, scale lengths in m; intensity 0: no gusts.

    A frozen gust field passes at `speed_mps`, so the correlation times are length / speed. For
    heights below 300 m, MIL-F-8785C has the vertical length equal to the height, and the horizontal
    intensity up to 1.8 times the vertical one.
    """

    intensity_mps: float = Field(default=0.0, ge=0, le=15)  # sd along and across the mean wind
    vertical_ratio: float = Field(default=0.5, ge=0, le=2)  # vertical sd / intensity
    length_m: float = Field(default=20.0, ge=0.1, le=2000)  # L_u = L_v
    vertical_length_m: float = Field(default=5.0, ge=0.1, le=2000)  # L_w
    speed_mps: float = Field(default=5.0, ge=0.1, le=50)


def dryden(gusts: Gusts, step_s: float) -> LinearProcess:
    """Return the gust process with states [u, v, v~, w, w~]: along the mean wind, across and down
    are states 0, 1 and 3."""
    time_s = gusts.length_m / gusts.speed_mps
    down_time_s = gusts.vertical_length_m / gusts.speed_mps
    along = discretise([[-1.0 / time_s]], [gusts.intensity_mps * math.sqrt(2.0 / time_s)], step_s)
    across = _transverse(gusts.intensity_mps, time_s, step_s)
    down = _transverse(gusts.intensity_mps * gusts.vertical_ratio, down_time_s, step_s)
    return block_diagonal(along, across, down)


def _transverse(sd_mps: float, time_s: float, step_s: float) -> LinearProcess:
    """Filter sd sqrt(tau) (1 + sqrt(3) tau s) / (1 + tau s)^2 of white noise with unit density.

    As x' = (-x + k y)/tau + sqrt(3/tau) sd w, y' = -y/tau + w; the first state is the gust.
    """
    root_three = math.sqrt(3.0)
    direct = sd_mps * root_three / math.sqrt(time_s)
    chained = sd_mps * (1.0 - root_three) / time_s**1.5
    drift = np.array([[-1.0 / time_s, chained], [0.0, -1.0 / time_s]])
    return discretise(drift, np.array([[direct], [1.0]]), step_s)


def wind_axes(wind_ned_mps: tuple[float, float, float]) -> tuple[float, float]:
    """Return (cos, sin) of the direction to which the steady wind blows; north without wind."""
    north, east, _ = wind_ned_mps
    speed = math.hypot(north, east)
    return (north / speed, east / speed) if speed > 1e-9 else (1.0, 0.0)
