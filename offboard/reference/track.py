"""References in time: a path flown from rest to rest, and references moved, delayed and paused.

A `Track` has a run-in, a scored part at full speed and a run-out. On an unbounded path (circle,
lemniscate, helix) the run-in covers the first run_in_s / 2 of the path; exactly the laps follow,
and the run-out continues along the path for run_out_s / 2. On a bounded path (line, waypoints,
table) both runs lie within its ends, and only the part between them is flown at full speed and
scored. A hover has no runs and is scored throughout.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from offboard.reference.base import FlatSample, Reference
from offboard.reference.path import HEADING, AlongVelocity, Harmonic, Path, Triple

Array = NDArray[np.float64]

STOP_S = 2.5  # duration of the stop of a pause, and of the start after it; similar to a run-out
_BEFORE_S = 1e6  # longer than any flight: full speed before a stop and after a start
_REST_SPEED_MPS = 1e-3  # slower counts as at rest


def warp(time_s: Array, run_in_s: float, cruise_s: float, run_out_s: float) -> Array:
    """Return the path's time s(t) of a smooth start and stop, with four derivatives, (5, N), for t
    (N,).

    ds/dt rises from 0 to 1 within `run_in_s`, is 1 for `cruise_s`, and falls to 0 within
    `run_out_s`. It follows the smoothstep of degree 9: four derivatives of ds/dt are zero at every
    joint. A run of duration R covers R / 2 of the path. Before and after, s is constant.
    """
    out = np.zeros((5, time_s.size))
    cruise_end_s = run_in_s + cruise_s
    end_s = cruise_end_s + run_out_s
    length_s = 0.5 * run_in_s + cruise_s + 0.5 * run_out_s
    starts = (time_s >= 0.0) & (time_s < run_in_s)
    cruises = (time_s >= run_in_s) & (time_s <= cruise_end_s)
    stops = (time_s > cruise_end_s) & (time_s < end_s)
    out[:, starts] = _ramp(time_s[starts] / run_in_s, run_in_s, 1.0) if starts.any() else 0.0
    out[0, cruises] = time_s[cruises] - 0.5 * run_in_s
    out[1, cruises] = 1.0
    if stops.any():
        out[:, stops] = _ramp((end_s - time_s[stops]) / run_out_s, run_out_s, -1.0)
    out[0, time_s > cruise_end_s] += length_s
    return out


def _ramp(x: Array, duration_s: float, direction: float) -> Array:
    """Return s, whose rate is the smoothstep of degree 9, and four derivatives by time (5, N), at
    x (N,) in [0, 1]. A `direction` of -1 reverses time: s and its even derivatives change sign.
    """
    u = x * (1.0 - x)
    shape = 21.0 + x * (-60.0 + x * (67.5 + x * (-35.0 + 7.0 * x)))
    slope = 126.0 + x * (-420.0 + x * (540.0 + x * (-315.0 + 70.0 * x)))
    return np.array(
        [
            direction * duration_s * x**6 * shape,
            x**5 * slope,
            direction * 630.0 * u**4 / duration_s,
            2520.0 * u**3 * (1.0 - 2.0 * x) / duration_s**2,
            direction * 2520.0 * u**2 * (3.0 - 14.0 * u) / duration_s**3,
        ]
    )


def _composed(clock: Array, jet: Array, shape: tuple[int, ...]) -> FlatSample:
    """Return the sample, of leading shape `shape`, of a path at s(t), by the chain rule to the
    fourth derivative (Faa di Bruno). `clock` (5, N) is s(t) with its derivatives by time, `jet`
    (5, N, 4) is [north, east, down, heading] with its derivatives by s."""
    s1, s2, s3, s4 = clock[1:, :, np.newaxis]
    p0, p1, p2, p3, p4 = jet
    by_time = np.array(
        [
            p0,
            p1 * s1,
            p2 * s1**2 + p1 * s2,
            p3 * s1**3 + 3.0 * p2 * s1 * s2 + p1 * s3,
            p4 * s1**4 + 6.0 * p3 * s1**2 * s2 + p2 * (3.0 * s2**2 + 4.0 * s1 * s3) + p1 * s4,
        ]
    ).reshape(5, *shape, 4)
    return FlatSample(*by_time[..., :HEADING], *by_time[:3, ..., HEADING])


@dataclass(frozen=True, slots=True)
class Track:
    """A `Reference` from rest to rest, continuous to snap in position and to acceleration in
    heading (at an end without run-in or run-out, as continuous as the path is there).

    Time 0 is the start of the run-in; positions are NED relative to the takeoff point. `heading`
    is constant, rad, or along the velocity. A fourth column of the path replaces a constant one.
    """

    path: Path
    heading: float | AlongVelocity = 0.0
    run_in_s: float = 0.0
    run_out_s: float = 0.0
    origin_ned_m: Triple = (0.0, 0.0, 0.0)

    def check_runs(self) -> None:
        """Raise ValueError if the runs do not fit in a bounded path, or if a run is zero although
        the path moves at that end."""
        if self.cruise_s <= 0.0:
            raise ValueError(
                f"run-in and run-out ({self.run_in_s:g} s and {self.run_out_s:g} s) take half "
                f"their duration of the path, which is only {self.path.length_s:.3g} s long; "
                "lower run_in_s and run_out_s"
            )
        ends = self.path.jet(np.array([0.0, self.path_end_s]))
        speeds_mps = np.linalg.norm(ends[1, :, :HEADING], axis=1)
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
        if self.path.bounded:
            return self.path.length_s
        return self.path.length_s + 0.5 * (self.run_in_s + self.run_out_s)

    @property
    def track_start_s(self) -> float:
        """Start of the scored part."""
        return self.run_in_s

    @property
    def track_end_s(self) -> float:
        """End of the scored part."""
        return self.track_start_s + self.cruise_s

    @property
    def duration_s(self) -> float:
        """The time at which the track comes to rest."""
        return self.track_end_s + self.run_out_s

    def path_time_s(self, time_s: float) -> float:
        """Return the path's own time at `time_s`, for a table the time since its first row."""
        return float(self._clock(np.array([time_s]))[0, 0])

    def sample(self, time_s: float | Array) -> FlatSample:
        """Return the sample at `time_s`, a scalar or an array of any shape; before the start and
        after the end it is at rest."""
        time = np.asarray(time_s, dtype=np.float64)
        clock = self._clock(time.reshape(-1))
        jet = np.zeros((5, time.size, 4))
        path = self.path.jet(clock[0])
        jet[..., : path.shape[-1]] = path
        jet[0, :, :HEADING] += self.origin_ned_m
        if isinstance(self.heading, AlongVelocity):
            jet[:3, :, HEADING] = self.heading.jet(clock[0], path)
        elif path.shape[-1] == HEADING:
            jet[0, :, HEADING] = self.heading
        return _composed(clock, jet, time.shape)

    def _clock(self, time_s: Array) -> Array:
        return warp(time_s, self.run_in_s, self.cruise_s, self.run_out_s)


def hold(position_ned_m: Triple, heading_rad: float) -> Track:
    """Return a reference at rest at a point (NED, m) with a heading (rad)."""
    return Track(Harmonic(0.0, bounded=True, offset_ned_m=position_ned_m), heading_rad)


@dataclass(frozen=True, slots=True)
class Moved:
    """A reference moved to another time axis and place, which may be paused. Its own time then
    slows down to a stop within `STOP_S`, and later runs again. The path stays the same and
    continuous to snap.

    Args:
        reference: the reference in its own time and frame.
        start_s: its time 0 on the new axis, such as vehicle time.
        origin_ned_m: its origin in the new frame, such as the takeoff point.
        paused_s: time on the new axis at which the stop begins.
        resumed_s: time on the new axis at which the start begins, at the earliest when at rest.
    """

    reference: Reference
    start_s: float = 0.0
    origin_ned_m: Triple = (0.0, 0.0, 0.0)
    paused_s: float = math.inf
    resumed_s: float = math.inf

    @property
    def duration_s(self) -> float:
        """The end on the new axis; infinite while the reference is paused."""
        end_s = self.start_s + self.reference.duration_s
        if self.paused_s == math.inf:
            return end_s
        return end_s + self.resumed_s - self.paused_s  # stop and start each cover half their time

    def resumed(self, time_s: float) -> Moved:
        """Return this reference, resumed at `time_s` or when it comes to rest, if that is later."""
        return replace(self, resumed_s=max(time_s, self.paused_s + STOP_S))

    def at_full_speed(self, time_s: float) -> bool:
        """Whether the reference runs at full speed at `time_s`: before a pause or after it."""
        return time_s < self.paused_s or time_s >= self.resumed_s + STOP_S

    def own_s(self, time_s: float) -> float:
        """Return the own time, at `time_s`, of the reference that was moved, once or repeatedly."""
        own_s = float(self._clock(np.array([time_s]))[0, 0])
        return self.reference.own_s(own_s) if isinstance(self.reference, Moved) else own_s

    def sample(self, time_s: float | Array) -> FlatSample:
        """Return the sample at `time_s`, a scalar or an array of any shape."""
        time = np.asarray(time_s, dtype=np.float64)
        if self.paused_s == math.inf:
            sample = self.reference.sample(time - self.start_s)
        else:
            clock = self._clock(time.reshape(-1))
            inner = self.reference.sample(clock[0])
            jet = np.zeros((5, time.size, 4))
            jet[..., :HEADING], jet[:3, :, HEADING] = inner[:5], inner[5:]
            sample = _composed(clock, jet, time.shape)
        return sample._replace(position_ned_m=sample.position_ned_m + np.array(self.origin_ned_m))

    def _clock(self, time_s: Array) -> Array:
        """Return the reference's own time and four derivatives (5, N) at `time_s` (N,)."""
        if self.paused_s == math.inf:
            clock = np.zeros((5, time_s.size))
            clock[0], clock[1] = time_s, 1.0
        else:
            clock = warp(time_s - self.paused_s + _BEFORE_S, 0.0, _BEFORE_S, STOP_S)
            clock[0] += self.paused_s - _BEFORE_S
            again = time_s >= self.resumed_s
            clock[:, again] = warp(time_s[again] - self.resumed_s, STOP_S, _BEFORE_S, 0.0)
            clock[0, again] += self.paused_s + 0.5 * STOP_S
        clock[0] -= self.start_s
        return clock
