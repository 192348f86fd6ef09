"""Keep-out volumes and the distance to them: spheres, upright cylinders, boxes, at rest or moving.

They are given like references: metres north and east of the take-off point, and above it.
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

CHECK_STEP_S = 0.02

# Columns of a packed volume: centre NED, velocity NED, half sizes NED of a box; radius added on all
# sides (sphere), and horizontally (cylinder)
CENTRE, VELOCITY, HALF, ROUND, RADIUS = 0, 3, 6, 9, 10
PACKED_SIZE = 11


class _KeepOut(Parameters):
    """Centre when the reference starts, and velocity from then on; before, the volume rests."""

    north_m: Metres
    east_m: Metres
    height_m: Metres
    velocity_north_mps: Speed = 0.0
    velocity_east_mps: Speed = 0.0
    velocity_up_mps: Speed = 0.0

    def packed(self) -> Array:
        """The volume as (PACKED_SIZE,), NED, relative to the take-off point."""
        row = np.zeros(PACKED_SIZE)
        row[CENTRE : CENTRE + 3] = self.north_m, self.east_m, -self.height_m
        row[VELOCITY : VELOCITY + 3] = (
            self.velocity_north_mps,
            self.velocity_east_mps,
            -self.velocity_up_mps,
        )
        return row


class Sphere(_KeepOut):
    """A sphere of `radius_m`."""

    shape: Literal["sphere"]
    radius_m: Size

    def packed(self) -> Array:
        row = super().packed()
        row[ROUND] = self.radius_m
        return row


class Cylinder(_KeepOut):
    """An upright cylinder, `length_m` high."""

    shape: Literal["cylinder"]
    radius_m: Size
    length_m: Size

    def packed(self) -> Array:
        row = super().packed()
        row[RADIUS] = self.radius_m
        row[HALF + 2] = 0.5 * self.length_m
        return row


class Box(_KeepOut):
    """A box with sides along north, east and the vertical."""

    shape: Literal["box"]
    size_north_m: Size
    size_east_m: Size
    size_up_m: Size

    def packed(self) -> Array:
        row = super().packed()
        row[HALF : HALF + 3] = (
            0.5 * self.size_north_m,
            0.5 * self.size_east_m,
            0.5 * self.size_up_m,
        )
        return row


KeepOut = Annotated[Sphere | Cylinder | Box, Field(discriminator="shape")]


def pack(volumes: Sequence[Sphere | Cylinder | Box]) -> Array:
    """The volumes as (V, PACKED_SIZE)."""
    rows = np.zeros((len(volumes), PACKED_SIZE))
    for row, volume in zip(rows, volumes, strict=True):
        row[:] = volume.packed()
    return rows


@kernel
def distance(
    volume: Any,
    centre_north: float,
    centre_east: float,
    centre_down: float,
    north: float,
    east: float,
    down: float,
) -> float:
    """Distance of a point from the surface of a packed volume with this centre, negative inside."""
    off_n = abs(north - centre_north)
    off_e = abs(east - centre_east)
    off_d = abs(down - centre_down) - volume[HALF + 2]
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
    """The packed volumes at a time since the start of the reference; NaN and negative times count
    as 0."""
    there = volumes.copy()
    elapsed_s = max(track_time_s, 0.0) if track_time_s == track_time_s else 0.0
    there[:, CENTRE:VELOCITY] += origin_ned_m + elapsed_s * there[:, VELOCITY:HALF]
    return there


def clearances(
    volumes: Sequence[Sphere | Cylinder | Box], times_s: Array, positions_ned_m: Array
) -> Array:
    """Distance to the nearest volume, (n,), at times (n,) since the start of the reference and
    positions (n, 3) relative to the take-off point. It is inf where no volumes are given."""
    packed, origin = pack(volumes), np.zeros(3)
    nearest = np.full(len(times_s), np.inf)
    for i, (time_s, position) in enumerate(zip(times_s, positions_ned_m, strict=True)):
        for row in placed_at(packed, origin, float(time_s)).tolist():
            nearest[i] = min(nearest[i], distance(row, *row[CENTRE:VELOCITY], *position))
    return nearest


def refusal(
    volumes: Sequence[Sphere | Cylinder | Box], clearance_m: float, reference: Reference
) -> str | None:
    """Why `reference`, relative to the take-off point, conflicts with the volumes; or None."""
    for number, volume in enumerate(volumes):
        times = np.arange(0.0, reference.duration_s + CHECK_STEP_S, CHECK_STEP_S)
        path = reference.sample(times).position_ned_m
        gaps = clearances((volume,), times, path)
        ground = float(clearances((volume,), np.zeros(1), np.zeros((1, 3)))[0])
        named = f"keep_out[{number}] ({volume.shape})"
        within = f"with its clearance of {clearance_m:g} m"
        if ground < clearance_m:
            return f"{named} contains the take-off point {within} ({ground:.2f} m from its surface)"
        if bool((gaps < clearance_m).all()):
            return f"{named} contains the whole path {within}"
        for place, gap in (("start", gaps[0]), ("end", gaps[-1])):
            if gap < clearance_m:
                return (
                    f"{named} contains the {place} of the reference {within} "
                    f"({gap:.2f} m from its surface)"
                )
    return None
