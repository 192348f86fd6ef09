"""The shapes of references: one class per shape, with its settings and its path.

A reference file (`config/references/*.yaml`) holds the settings of one shape, named by `shape`.
Heights are metres above the takeoff point, positive up; other coordinates are metres north and
east of it. A new shape is a class here, a row in `SHAPES` and a file. This module reads no file.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from offboard.documents.parameters import Parameters
from offboard.reference import table
from offboard.reference.fastest import PathLimits, fastest_times
from offboard.reference.path import (
    AlongVelocity,
    Harmonic,
    Path,
    Sine,
    Smoothness,
    interpolate,
    through,
    times_from_speed,
)
from offboard.reference.track import Track

Seconds = Annotated[float, Field(ge=0, le=60)]
Period = Annotated[float, Field(ge=1, le=600)]
Laps = Annotated[int, Field(ge=1, le=100)]
Height = Annotated[float, Field(ge=0.5, le=500)]
Coordinate = Annotated[float, Field(ge=-1000, le=1000)]
Size = Annotated[float, Field(ge=0.05, le=500)]
Speed = Annotated[float, Field(ge=0.05, le=30)]
Climb = Annotated[float, Field(ge=-5, le=5)]
Term = tuple[
    Annotated[float, Field(ge=-500, le=500)],
    Annotated[int, Field(ge=1, le=20)],
    Annotated[float, Field(ge=-360, le=360)],
]

# Largest change, in m and rad, by which dense rows of a table are smoothed, and knots of that fit
ROUNDED, ROUNDED_KNOTS_S = 0.03, 0.5


class Shape(Parameters, ABC):
    """Settings of every shape. Its origin is `height_m` above the takeoff point, and
    `origin_north_m` and `origin_east_m` from it; `course_deg` is the fixed heading, clockwise from
    north. The vehicle accelerates during `run_in_s` and brakes during `run_out_s`; see `Track`.
    """

    shape: str
    height_m: Height = 3.0
    origin_north_m: Coordinate = 0.0
    origin_east_m: Coordinate = 0.0
    course: Literal["fixed", "along_velocity"] = "fixed"
    course_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    run_in_s: Seconds = 4.0
    run_out_s: Seconds = 3.0

    pace: ClassVar[str] = "period_s"  # the settings that make the path slower

    @abstractmethod
    def path(self) -> Path:
        """Return the path at full speed, NED relative to the origin.

        Raises ValueError with one sentence if these settings make no path.
        """

    def track(self) -> Track:
        """Return the reference, NED relative to the takeoff point. Raises ValueError like `path`,
        and if the runs do not fit (`Track.check_runs`)."""
        path, fixed_rad = self.path(), math.radians(self.course_deg)
        origin_ned_m = (self.origin_north_m, self.origin_east_m, -float(self.height_m))
        track = Track(path, fixed_rad, self.run_in_s, self.run_out_s, origin_ned_m)
        track.check_runs()
        if self.course == "along_velocity":
            track = replace(track, heading=AlongVelocity(path, track.path_end_s, fixed_rad))
        return track

    @property
    def title(self) -> str:
        """Name of the reference in errors."""
        return self.shape

    @property
    def slower(self) -> str:
        """What to change if it is too fast for a vehicle."""
        return f"fly it slower ({self.pace}; its ends: run_in_s, run_out_s)"


class Hover(Shape):
    """At rest at the origin."""

    shape: Literal["hover"] = "hover"
    duration_s: Annotated[float, Field(ge=0.1, le=3600)] = 15.0
    run_in_s: Literal[0] = 0
    run_out_s: Literal[0] = 0

    def path(self) -> Path:
        return Harmonic(self.duration_s, bounded=True)


class Line(Shape):
    """A straight line from the origin to a point relative to it, at constant speed between run-in
    and run-out."""

    shape: Literal["line"] = "line"
    to_north_m: Coordinate = 10.0
    to_east_m: Coordinate = 0.0
    climb_m: Annotated[float, Field(ge=-500, le=500)] = 0.0
    speed_mps: Speed = 1.5

    pace: ClassVar[str] = "speed_mps"

    def path(self) -> Path:
        displacement = (self.to_north_m, self.to_east_m, -self.climb_m)
        distance_m = math.hypot(*displacement)
        if distance_m < 1e-6:
            raise ValueError("a line needs a displacement longer than zero")
        north, east, down = (self.speed_mps * part / distance_m for part in displacement)
        return Harmonic(
            distance_m / self.speed_mps, bounded=True, slope_ned_mps=(north, east, down)
        )


class Helix(Shape):
    """A circle round the origin, clockwise seen from above, that begins north of it at `height_m`
    and climbs."""

    shape: Literal["helix"] = "helix"
    radius_m: Size = 1.5
    period_s: Period = 10.0
    climb_mps: Climb = 0.4
    laps: Laps = 2

    def path(self) -> Path:
        omega = 2.0 * math.pi / self.period_s
        return Harmonic(
            self.laps * self.period_s,
            slope_ned_mps=(0.0, 0.0, -self.climb_mps),
            sines=(
                Sine(
                    (self.radius_m, self.radius_m, 0.0),
                    (omega, omega, 0.0),
                    (0.5 * math.pi, 0.0, 0.0),
                ),
            ),
        )


class Circle(Shape):
    """A level circle round the origin, clockwise seen from above, that begins north of it."""

    shape: Literal["circle"] = "circle"
    radius_m: Size = 2.0
    period_s: Period = 8.0
    laps: Laps = 2

    def path(self) -> Path:
        return Helix(
            radius_m=self.radius_m, period_s=self.period_s, climb_mps=0.0, laps=self.laps
        ).path()


class Lemniscate(Shape):
    """A level figure of eight about the origin: north = half_length sin(w s), east = half_width
    sin(2 w s), w = 2 pi / period."""

    shape: Literal["lemniscate"] = "lemniscate"
    half_length_m: Size = 2.0
    half_width_m: Size = 1.0
    period_s: Period = 8.0
    laps: Laps = 2

    def path(self) -> Path:
        omega = 2.0 * math.pi / self.period_s
        return Harmonic(
            self.laps * self.period_s,
            sines=(Sine((self.half_length_m, self.half_width_m, 0.0), (omega, 2.0 * omega, 0.0)),),
        )


class Sines(Shape):
    """A closed curve about the origin, in each axis a sum of sines. An entry [amplitude in m,
    cycles per period, phase in deg] adds amplitude sin(2 pi cycles s / period + phase)."""

    shape: Literal["sines"] = "sines"
    north: Annotated[tuple[Term, ...], Field(max_length=10)] = ()
    east: Annotated[tuple[Term, ...], Field(max_length=10)] = ()
    up: Annotated[tuple[Term, ...], Field(max_length=10)] = ()
    period_s: Period = 8.0
    laps: Laps = 2

    @model_validator(mode="after")
    def _moves(self) -> Self:
        if not (self.north or self.east or self.up):
            raise ValueError("north, east or up needs a sine")
        return self

    def path(self) -> Path:
        omega = 2.0 * math.pi / self.period_s
        terms = zip(np.diag((1.0, 1.0, -1.0)), (self.north, self.east, self.up), strict=True)
        sines = tuple(
            Sine(tuple(amplitude_m * axis), (cycles * omega,) * 3, (math.radians(phase),) * 3)
            for axis, entries in terms
            for amplitude_m, cycles, phase in entries
        )
        return Harmonic(self.laps * self.period_s, sines=sines)


class Waypoints(Shape):
    """A smooth path from rest to rest through points [north, east, up] m, relative to the origin,
    at `times_s`, at a mean speed `speed_mps`, or as fast as the limits of `fastest` allow."""

    shape: Literal["waypoints"] = "waypoints"
    points_m: Annotated[
        tuple[tuple[Coordinate, Coordinate, Coordinate], ...], Field(min_length=2, max_length=500)
    ]
    speed_mps: Speed | None = None
    times_s: tuple[Annotated[float, Field(ge=0, le=3600)], ...] | None = None
    fastest: PathLimits | None = None
    minimise: Smoothness = Smoothness.SNAP
    run_in_s: Seconds = 1.0
    run_out_s: Seconds = 1.0

    pace: ClassVar[str] = "speed_mps, times_s or the limits of fastest"

    @model_validator(mode="after")
    def _makes_a_path(self) -> Self:
        if [self.speed_mps, self.times_s, self.fastest].count(None) != 2:
            raise ValueError("waypoints need one of speed_mps, times_s and fastest")
        self.path()
        return self

    def times(self) -> NDArray[np.float64]:
        """Return the times (N,) at which the path passes the points, s from its start. Raises
        ValueError like `path`."""
        if self.fastest is not None:
            return np.array(fastest_times(self.points_m, self.minimise, self.fastest))
        if self.speed_mps is not None:
            return times_from_speed(np.array(self.points_m), self.speed_mps)
        return np.array(self.times_s or (), dtype=np.float64)

    def path(self) -> Path:
        points = np.array(self.points_m, dtype=np.float64) * (1.0, 1.0, -1.0)
        return through(points, self.times(), self.minimise)


class FromTable(Shape):
    """A CSV table (see `table`). Positions and heights are relative to the takeoff point.

    `course: table` uses the column course_deg, or the fixed `course_deg` if the table has no such
    column. `knot_spacing_s` > 0 smooths noisy rows, 0 passes through every row. Without it, dense
    rows are smoothed by at most ROUNDED, because their rounding would demand great accelerations.
    `text` is the content of `file`, filled in by the reader of the file, so that a recorded
    configuration is complete.
    """

    shape: Literal["table"] = "table"
    file: Annotated[str, Field(min_length=1, max_length=4096)]
    text: str | None = None
    height_m: Literal[0] = 0
    knot_spacing_s: Annotated[float | None, Field(ge=0, le=60)] = None
    course: Literal["table", "fixed", "along_velocity"] = "table"  # type: ignore[assignment]
    run_in_s: Seconds = 2.0
    run_out_s: Seconds = 2.0

    pace: ClassVar[str] = "time_s of its rows, or knot_spacing_s=0.5 if they are noisy"

    @property
    def title(self) -> str:
        return self.file

    def path(self) -> Path:
        if self.text is None:
            raise ValueError(f"the table {self.file} has not been read")
        rows = table.parse(self.text, self.file)
        values = rows.points_ned_m
        if self.course == "table" and rows.heading_rad is not None:
            values = np.column_stack((values, rows.heading_rad))
        if self.knot_spacing_s is not None:
            return interpolate(rows.times_s, values, self.knot_spacing_s)
        smooth = interpolate(rows.times_s, values, ROUNDED_KNOTS_S)
        is_near = np.abs(smooth.jet(rows.times_s)[0] - values).max() <= ROUNDED
        return smooth if is_near else interpolate(rows.times_s, values)


SHAPES: Mapping[str, type[Shape]] = {
    "hover": Hover,
    "line": Line,
    "circle": Circle,
    "lemniscate": Lemniscate,
    "helix": Helix,
    "sines": Sines,
    "waypoints": Waypoints,
    "table": FromTable,
}
