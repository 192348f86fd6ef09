"""Keep-out volumes (spheres, upright cylinders, boxes, at rest or moving) and the distance to them.

Positions are given as in references: metres north and east of the takeoff point, and above it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from offboard.compiled import kernel
from offboard.documents.parameters import Parameters
from offboard.reference.base import Reference

Array = NDArray[np.float64]
Metres = Annotated[float, Field(ge=-1000, le=1000)]
Size = Annotated[float, Field(gt=0, le=500)]
Speed = Annotated[float, Field(ge=-20, le=20)]

CHECK_STEP_S = 0.02  # between samples of a reference that is checked

# First columns of a packed volume: centre (NED), velocity (NED), half sizes (NED) of a box, radius
# added on all sides (sphere), radius added horizontally (cylinder)
CENTRE, VELOCITY, HALF, ROUND, RADIUS = 0, 3, 6, 9, 10
PACKED_SIZE = 11


class _KeepOut(Parameters):
    """Centre at the start of the reference, and velocity from then on; before, it is at rest."""

    north_m: Metres
    east_m: Metres
    height_m: Metres
    velocity_north_mps: Speed = 0.0
    velocity_east_mps: Speed = 0.0
    velocity_up_mps: Speed = 0.0


class Sphere(_KeepOut):
    """A sphere of `radius_m`."""

    shape: Literal["sphere"]
    radius_m: Size

    @property
    def sizes(self) -> tuple[float, ...]:
        """Columns from HALF to the last one of a packed volume."""
        return 0.0, 0.0, 0.0, self.radius_m, 0.0


class Cylinder(_KeepOut):
    """An upright cylinder, `length_m` high."""

    shape: Literal["cylinder"]
    radius_m: Size
    length_m: Size

    @property
    def sizes(self) -> tuple[float, ...]:
        """Columns from HALF to the last one of a packed volume."""
        return 0.0, 0.0, 0.5 * self.length_m, 0.0, self.radius_m


class Box(_KeepOut):
    """A box with sides along north, east and the vertical."""

    shape: Literal["box"]
    size_north_m: Size
    size_east_m: Size
    size_up_m: Size

    @property
    def sizes(self) -> tuple[float, ...]:
        """Columns from HALF to the last one of a packed volume."""
        return 0.5 * self.size_north_m, 0.5 * self.size_east_m, 0.5 * self.size_up_m, 0.0, 0.0


Volume = Sphere | Cylinder | Box
KeepOut = Annotated[Volume, Field(discriminator="shape")]


def pack(volumes: Sequence[Volume]) -> Array:
    """Return the volumes as (V, PACKED_SIZE), NED, relative to the takeoff point."""
    rows = [
        (
            *(each.north_m, each.east_m, -each.height_m),
            *(each.velocity_north_mps, each.velocity_east_mps, -each.velocity_up_mps),
            *each.sizes,
        )
        for each in volumes
    ]
    return np.array(rows, np.float64).reshape(-1, PACKED_SIZE)


@kernel
def distance(volume: Any, north: float, east: float, down: float) -> float:
    """Return the distance of a point from the surface of a packed volume, m, negative inside. The
    point is given in NED relative to the volume's centre."""
    off_n, off_e, off_d = abs(north), abs(east), abs(down) - volume[HALF + 2]
    if volume[RADIUS] > 0.0:
        flat = math.sqrt(off_n * off_n + off_e * off_e) - volume[RADIUS]
        deepest = max(flat, off_d)
        outside = max(flat, 0.0) ** 2 + max(off_d, 0.0) ** 2
    else:
        off_n -= volume[HALF]
        off_e -= volume[HALF + 1]
        deepest = max(off_n, max(off_e, off_d))
        outside = max(off_n, 0.0) ** 2 + max(off_e, 0.0) ** 2 + max(off_d, 0.0) ** 2
    return float(min(deepest, 0.0) + math.sqrt(outside) - volume[ROUND])


def placed_at(volumes: Array, origin_ned_m: Array, track_time_s: float) -> Array:
    """Return the packed volumes in local NED at a time since the start of the reference; NaN and
    negative times count as 0."""
    there = volumes.copy()
    elapsed_s = max(track_time_s, 0.0) if track_time_s == track_time_s else 0.0
    there[:, CENTRE:VELOCITY] += origin_ned_m + elapsed_s * there[:, VELOCITY:HALF]
    return there


def clearances(volumes: Sequence[Volume], times_s: Array, positions_ned_m: Array) -> Array:
    """Return the distance (n,) to the nearest volume, m, at times (n,) since the start of the
    reference and positions (n, 3) relative to the takeoff point; inf without volumes."""
    packed, origin = pack(volumes), np.zeros(3)
    nearest = np.full(len(times_s), np.inf)
    for i, (time_s, position) in enumerate(zip(times_s, positions_ned_m, strict=True)):
        for row in placed_at(packed, origin, float(time_s)).tolist():
            away = distance(row, *(position - row[CENTRE:VELOCITY]))
            nearest[i] = min(nearest[i], away)
    return nearest


def refusal(volumes: Sequence[Volume], clearance_m: float, reference: Reference) -> str | None:
    """Return why `reference`, relative to the takeoff point, conflicts with the volumes, or None
    if it does not."""
    times = np.arange(0.0, reference.duration_s + CHECK_STEP_S, CHECK_STEP_S)
    path = reference.sample(times).position_ned_m
    for number, volume in enumerate(volumes):
        gaps = clearances((volume,), times, path)
        ground = clearances((volume,), np.zeros(1), np.zeros((1, 3)))[0]
        for what, inside, gap in (
            ("takeoff point", ground < clearance_m, ground),
            ("whole path", (gaps < clearance_m).all(), None),
            ("start of the reference", gaps[0] < clearance_m, gaps[0]),
            ("end of the reference", gaps[-1] < clearance_m, gaps[-1]),
        ):
            if inside:
                near = "" if gap is None else f" ({gap:.2f} m from its surface)"
                return (
                    f"keep_out[{number}] ({volume.shape}) contains the {what} "
                    f"with its clearance of {clearance_m:g} m{near}"
                )
    return None
