"""The references by name: one configuration value per shape, and the track built from it.

A reference file (`config/references/*.yaml`) is one of these values, told apart by `shape`.
Heights are metres above the take-off point, positive up; everything else is north and east of
it. No file is read here: the text of a table is handed in.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, TypeAdapter, model_validator

from offboard.documents.parameters import Parameters
from offboard.reference import shapes, table, waypoints
from offboard.reference.course import Course, Fixed, Tabulated, along_velocity
from offboard.reference.path import Path
from offboard.reference.track import Track, path_end_s

Seconds = Annotated[float, Field(ge=0, le=60)]
Period = Annotated[float, Field(ge=1, le=600)]
Laps = Annotated[int, Field(ge=1, le=100)]
Height = Annotated[float, Field(ge=0.5, le=500)]
Coordinate = Annotated[float, Field(ge=-1000, le=1000)]
Size = Annotated[float, Field(gt=0.05, le=500)]
Speed = Annotated[float, Field(gt=0.05, le=30)]


class CourseMode(StrEnum):
    """Where the nose points: a fixed course, along the horizontal velocity, or the table's."""

    FIXED = "fixed"
    ALONG_VELOCITY = "along_velocity"
    TABLE = "table"


class _Shape(Parameters):
    """What every shape has in common. The origin is north and east of the take-off point."""

    height_m: Height = 3.0
    origin_north_m: Coordinate = 0.0
    origin_east_m: Coordinate = 0.0
    course: Literal[CourseMode.FIXED, CourseMode.ALONG_VELOCITY] = CourseMode.FIXED
    course_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    run_in_s: Seconds = 4.0
    run_out_s: Seconds = 3.0


class Hover(_Shape):
    """Rest above the origin."""

    shape: Literal["hover"]
    duration_s: Annotated[float, Field(gt=0.1, le=3600)] = 15.0
    run_in_s: Literal[0] = 0
    run_out_s: Literal[0] = 0

    def path(self) -> Path:
        return shapes.hover(self.duration_s)


class Line(_Shape):
    """Straight from the origin to a point relative to it, at constant speed between the runs."""

    shape: Literal["line"]
    to_north_m: Coordinate = 10.0
    to_east_m: Coordinate = 0.0
    climb_m: Annotated[float, Field(ge=-500, le=500)] = 0.0
    speed_mps: Speed = 1.5

    def path(self) -> Path:
        return shapes.line((self.to_north_m, self.to_east_m, -self.climb_m), self.speed_mps)


class Circle(_Shape):
    """Level round the origin."""

    shape: Literal["circle"]
    radius_m: Size = 2.0
    period_s: Period = 8.0
    laps: Laps = 2

    def path(self) -> Path:
        return shapes.circle(self.radius_m, self.period_s, self.laps)


class Lemniscate(_Shape):
    """A level figure of eight with its centre at the origin."""

    shape: Literal["lemniscate"]
    half_length_m: Size = 2.0
    half_width_m: Size = 1.0
    period_s: Period = 8.0
    laps: Laps = 2

    def path(self) -> Path:
        return shapes.lemniscate(self.half_length_m, self.half_width_m, self.period_s, self.laps)


class Helix(_Shape):
    """Round the origin, climbing from `height_m`."""

    shape: Literal["helix"]
    radius_m: Size = 1.5
    period_s: Period = 10.0
    climb_mps: Annotated[float, Field(ge=-5, le=5)] = 0.4
    laps: Laps = 2

    def path(self) -> Path:
        return shapes.helix(self.radius_m, self.period_s, self.climb_mps, self.laps)


class Waypoints(_Shape):
    """A smooth path from rest to rest through points [north, east, up] m, relative to the origin
    and `height_m`; at `times_s`, or at a mean speed."""

    shape: Literal["waypoints"]
    points_m: Annotated[
        tuple[tuple[Coordinate, Coordinate, Coordinate], ...], Field(min_length=2, max_length=500)
    ]
    speed_mps: Speed | None = None
    times_s: tuple[Annotated[float, Field(ge=0, le=3600)], ...] | None = None
    minimise: waypoints.Smoothness = waypoints.Smoothness.SNAP
    run_in_s: Seconds = 1.0
    run_out_s: Seconds = 1.0

    @model_validator(mode="after")
    def _flyable(self) -> Self:
        if (self.speed_mps is None) == (self.times_s is None):
            raise ValueError("waypoints need one of speed_mps and times_s")
        self.path()
        return self

    def path(self) -> Path:
        points = np.array(self.points_m, dtype=np.float64) * (1.0, 1.0, -1.0)
        if self.speed_mps is not None:
            times = waypoints.times_from_speed(points, self.speed_mps)
        else:
            times = np.array(self.times_s or (), dtype=np.float64)
        return waypoints.through(points, times, self.minimise)


class FromTable(_Shape):
    """A CSV table (see `table`); positions relative to the take-off point, heights as written.

    `course: table` takes the column course_deg, and the fixed `course_deg` where there is none.
    `knot_spacing_s` > 0 smooths rounded or noisy rows. `text` is the file's content, kept by
    whoever read the file, so that a recorded configuration stands alone.
    """

    shape: Literal["table"]
    file: Annotated[str, Field(min_length=1, max_length=4096)]
    text: str | None = None
    height_m: Literal[0] = 0
    knot_spacing_s: Annotated[float, Field(ge=0, le=60)] = 0.0
    course: CourseMode = CourseMode.TABLE  # type: ignore[assignment]  # one choice more than others
    run_in_s: Seconds = 2.0
    run_out_s: Seconds = 2.0


Shape = Hover | Line | Circle | Lemniscate | Helix | Waypoints | FromTable
ReferenceConfig = Annotated[Shape, Field(discriminator="shape")]
adapter: TypeAdapter[Shape] = TypeAdapter(ReferenceConfig)

SHAPES: Mapping[str, type[Shape]] = {
    "hover": Hover,
    "line": Line,
    "circle": Circle,
    "lemniscate": Lemniscate,
    "helix": Helix,
    "waypoints": Waypoints,
    "table": FromTable,
}


def build(config: Shape, table_text: str | None = None) -> Track:
    """The track of a configuration, NED relative to the take-off point.

    `table_text` is the content of the file that a table names, where its `text` is not given.
    Raises ValueError (TableError for a table) with one sentence where the configuration does not
    make a path.
    """
    columns_course: Course | None = None
    if isinstance(config, FromTable):
        text = table_text if config.text is None else config.text
        if text is None:
            raise ValueError(f"the table {config.file} has not been read")
        path, columns_course = _from_table(config, text)
    else:
        path = config.path()
    if config.course is CourseMode.ALONG_VELOCITY:
        end_s = path_end_s(path, config.run_in_s, config.run_out_s)
        course = along_velocity(path, end_s, math.radians(config.course_deg))
    elif config.course is CourseMode.TABLE and columns_course is not None:
        course = columns_course
    else:
        course = Fixed(math.radians(config.course_deg))
    origin = (config.origin_north_m, config.origin_east_m, -float(config.height_m))
    return Track(path, course, config.run_in_s, config.run_out_s, origin)


def _from_table(config: FromTable, text: str) -> tuple[Path, Course | None]:
    rows = table.parse(text, config.file)
    path = table.interpolate(rows.times_s, rows.points_ned_m, config.knot_spacing_s)
    if rows.course_rad is None:
        return path, None
    column = rows.course_rad[:, np.newaxis]
    return path, Tabulated(table.interpolate(rows.times_s, column, config.knot_spacing_s))
