"""Frames: from NED and FRD to ENU and FLU, which Foxglove and ROS use. The only such conversion.

ENU is east, north, up; FLU is forward, left, up (REP 103).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_HALF = math.sqrt(0.5)
_NED_TO_ENU = (0.0, _HALF, _HALF, 0.0)  # half a turn about the axis between north and east
_FRD_TO_FLU = (0.0, 1.0, 0.0, 0.0)  # half a turn about the forward axis


def enu(ned: Array) -> Array:
    """Vectors (..., 3) in ENU, from NED."""
    return np.stack((ned[..., 1], ned[..., 0], -ned[..., 2]), axis=-1)


def flu_in_enu(frd_in_ned: Array) -> Array:
    """Attitudes (..., 4), w x y z, of the FLU body in ENU, from those of the FRD body in NED."""
    return _product(_product(np.array(_NED_TO_ENU), frd_in_ned), np.array(_FRD_TO_FLU))


def _product(first: Array, second: Array) -> Array:
    """Hamilton product of quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(first, -1, 0)
    a, b, c, d = np.moveaxis(second, -1, 0)
    return np.stack(
        (
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ),
        axis=-1,
    )
