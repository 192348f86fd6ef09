"""The analytic shapes: hover, line, circle, lemniscate, helix.

All are one formula, a straight motion plus one sine per axis, so that every derivative is closed
form. Positions are relative to the shape's origin; nothing here knows of heights above ground.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.reference.path import ORDERS

Array = NDArray[np.float64]
Triple = tuple[float, float, float]

_ZERO: Triple = (0.0, 0.0, 0.0)
_ORDER = np.arange(ORDERS, dtype=np.float64)[:, np.newaxis, np.newaxis]


@dataclass(frozen=True, slots=True)
class Harmonic:
    """p_i(s) = offset_i + slope_i s + amplitude_i sin(omega_i s + phase_i), i = north, east, down.

    Metres, metres per second, radians per second, radians. See `path.Path` for the rest.
    """

    length_s: float
    bounded: bool = False
    offset_ned_m: Triple = _ZERO
    slope_ned_mps: Triple = _ZERO
    amplitude_ned_m: Triple = _ZERO
    omega_ned_radps: Triple = _ZERO
    phase_ned_rad: Triple = _ZERO

    def jet(self, path_time_s: Array) -> Array:
        """Derivatives 0 to 4 with respect to s, shape (5, N, 3), for s of shape (N,)."""
        time = path_time_s[:, np.newaxis]
        omega = np.array(self.omega_ned_radps)
        angle = omega * time + np.array(self.phase_ned_rad)
        # d/ds of sin(omega s + phase) adds a quarter turn and a factor omega
        scale = np.array(self.amplitude_ned_m) * omega**_ORDER
        result: Array = scale * np.sin(angle + 0.5 * math.pi * _ORDER)
        slope = np.array(self.slope_ned_mps)
        result[0] += np.array(self.offset_ned_m) + slope * time
        result[1] += slope
        return result


def hover(duration_s: float) -> Harmonic:
    """Rest at the origin for `duration_s`."""
    return Harmonic(length_s=duration_s, bounded=True)


def line(displacement_ned_m: Triple, speed_mps: float) -> Harmonic:
    """Straight from the origin by the displacement at constant speed.

    Raises ValueError for a displacement of zero length."""
    distance_m = math.hypot(*displacement_ned_m)
    if distance_m < 1e-6:
        raise ValueError("a line needs a displacement longer than zero")
    north, east, down = (speed_mps * component / distance_m for component in displacement_ned_m)
    return Harmonic(
        length_s=distance_m / speed_mps, bounded=True, slope_ned_mps=(north, east, down)
    )


def helix(radius_m: float, period_s: float, climb_mps: float, laps: int) -> Harmonic:
    """Clockwise seen from above round the origin, from its north, climbing (positive up)."""
    omega = 2.0 * math.pi / period_s
    return Harmonic(
        length_s=laps * period_s,
        slope_ned_mps=(0.0, 0.0, -climb_mps),
        amplitude_ned_m=(radius_m, radius_m, 0.0),
        omega_ned_radps=(omega, omega, 0.0),
        phase_ned_rad=(0.5 * math.pi, 0.0, 0.0),
    )


def circle(radius_m: float, period_s: float, laps: int) -> Harmonic:
    """Level, clockwise seen from above round the origin, from its north."""
    return helix(radius_m, period_s, 0.0, laps)


def lemniscate(half_length_m: float, half_width_m: float, period_s: float, laps: int) -> Harmonic:
    """A level figure of eight from its centre, the origin: north = half_length sin(w s),
    east = half_width sin(2 w s), w = 2 pi / period."""
    omega = 2.0 * math.pi / period_s
    return Harmonic(
        length_s=laps * period_s,
        amplitude_ned_m=(half_length_m, half_width_m, 0.0),
        omega_ned_radps=(omega, 2.0 * omega, 0.0),
    )
