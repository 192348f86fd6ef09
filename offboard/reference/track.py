"""A path flown from rest to rest: run-in, the scored part at full speed, run-out.

On an unbounded path (circle, lemniscate, helix) the run-in covers the first run_in_s / 2 of it,
then come exactly the laps, and the run-out continues along it for run_out_s / 2. On a bounded path
(line, waypoints, table) both runs lie within its ends: only the part between is flown at full speed
and scored. A hover has no runs and is scored throughout.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.reference.base import FlatSample
from offboard.reference.heading import Heading
from offboard.reference.path import Path
from offboard.reference.warp import compose_heading, compose_position, warp

Array = NDArray[np.float64]

_REST_SPEED_MPS = 1e-3


@dataclass(frozen=True, slots=True)
class Track:
    """A `Reference` from rest to rest, continuous to snap in position and to acceleration in
    heading (without a run, at that end, as continuous as the path is there).

    Time 0 is the start of the run-in; positions are NED relative to the take-off point. Raises
    ValueError where the runs do not fit in a bounded path, or a run is zero and the path moves at
    that end.
    """

    path: Path
    heading: Heading
    run_in_s: float
    run_out_s: float
    origin_ned_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.cruise_s <= 0.0:
            raise ValueError(
                f"run-in and run-out ({self.run_in_s:g} s and {self.run_out_s:g} s) take half "
                f"their duration of the path, which is only {self.path.length_s:.3g} s long"
            )
        ends = self.path.jet(np.array([0.0, self.path_end_s]))
        speeds_mps = np.linalg.norm(ends[1], axis=1)
        for name, run_s, speed_mps in (
            ("run-in", self.run_in_s, float(speeds_mps[0])),
            ("run-out", self.run_out_s, float(speeds_mps[1])),
        ):
            if run_s == 0.0 and speed_mps > _REST_SPEED_MPS:
                raise ValueError(
                    f"without a {name} the path must be at rest there, but moves at "
                    f"{speed_mps:.3g} m/s"
                )

    @property
    def cruise_s(self) -> float:
        """Duration of the part flown at full speed."""
        if not self.path.bounded:
            return self.path.length_s
        return self.path.length_s - 0.5 * (self.run_in_s + self.run_out_s)

    @property
    def path_end_s(self) -> float:
        """The path's own time at which the track comes to rest."""
        return path_end_s(self.path, self.run_in_s, self.run_out_s)

    @property
    def track_start_s(self) -> float:
        """Start of the scored part."""
        return self.run_in_s

    @property
    def track_end_s(self) -> float:
        """End of the scored part."""
        return self.run_in_s + self.cruise_s

    @property
    def duration_s(self) -> float:
        return self.run_in_s + self.cruise_s + self.run_out_s

    def path_time_s(self, time_s: float) -> float:
        """The path's own time at `time_s`: of a table, the time in its rows, from the first."""
        runs = self.run_in_s, self.cruise_s, self.run_out_s
        return float(warp(np.array([time_s]), *runs)[0, 0])

    def sample(self, time_s: float | Array) -> FlatSample:
        """Flat outputs at `time_s`, a scalar or an array of any shape; at rest outside [0, end]."""
        time = np.asarray(time_s, dtype=np.float64)
        shape = time.shape
        s = warp(time.reshape(-1), self.run_in_s, self.cruise_s, self.run_out_s)
        path_jet = self.path.jet(s[0])
        position = compose_position(s, path_jet)
        position[0] += self.origin_ned_m
        heading = compose_heading(s, self.heading.jet(s[0], path_jet))
        return FlatSample(
            *(derivative.reshape(*shape, 3) for derivative in position),
            *(derivative.reshape(shape) for derivative in heading),
        )


def path_end_s(path: Path, run_in_s: float, run_out_s: float) -> float:
    """The path's own time at which a track along it comes to rest, in seconds."""
    if path.bounded:
        return path.length_s
    return path.length_s + 0.5 * (run_in_s + run_out_s)
