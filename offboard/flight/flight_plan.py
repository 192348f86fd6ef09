"""Flight plan: the reference in force at each vehicle time: the climb, then the track."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.mavlink.events import Triple
from offboard.reference.base import FlatSample, Reference
from offboard.reference.track import Moved, Track
from offboard.reference.transfer import Limits, stopping_place, transfer

Array = NDArray[np.float64]
# limits of the reference while it returns after a jump of the estimate
RETURN = Limits(speed_mps=0.5, acceleration_mps2=0.5, cruise_mps=0.5, cruise_vertical_mps=0.5)
CLEAR_M = 0.5  # least height above the ground of a track that is placed in the air
SINKS_MPS = 0.2  # a vehicle that sinks faster does not hover (PX4 lands at MPC_LAND_CRWL, 0.3)
SAMPLED_S = 0.1  # interval at which the height of the track is sampled


@dataclass(frozen=True, slots=True)
class Offset:
    """A reference with another one, the offset, added to its positions; same time axis."""

    reference: Reference
    offset: Reference

    @property
    def duration_s(self) -> float:
        return self.reference.duration_s

    def sample(self, time_s: float | Array) -> FlatSample:
        """Flat outputs at `time_s`, a scalar or an array of any shape."""
        sample, offset = self.reference.sample(time_s), self.offset.sample(time_s)
        return FlatSample._make((*map(np.add, sample[:5], offset[:5]), *sample[5:]))


class FlightPlan:
    """The reference in force: none on the ground, the climb after `start_climb`, and the track
    after `start_track`.

    `origin_ned_m` is the point to which the track's positions are relative: the takeoff point,
    except for a vehicle that was found in the air (`transitions`).
    """

    def __init__(self, track: Track) -> None:
        self.track = track
        self.origin_ned_m = (0.0, 0.0, 0.0)
        self._arrival_s = math.nan
        self._planned: Moved | None = None
        self._tracks = False  # whether `_planned` is the track, not the climb
        self._offset: Reference | None = None  # since a jump of the estimate

    @property
    def reference(self) -> Reference | None:
        """The reference in force."""
        if self._planned is None or self._offset is None:
            return self._planned
        return Offset(self._planned, self._offset)

    def start_climb(
        self, time_s: float, position_ned_m: Array, velocity_ned_mps: Array, heading_rad: float
    ) -> None:
        """Fly from this position and velocity (3,) to rest at the start of the track, along a flat
        way at the greater of the two heights."""
        start = Moved(self.track, origin_ned_m=self.origin_ned_m).sample(0.0)
        climb = transfer(
            position_ned_m,
            start.position_ned_m,
            heading_rad,
            float(start.heading_rad),
            start_velocity_ned_mps=velocity_ned_mps,
            keeps_height=True,
        )
        self._arrival_s = time_s + climb.duration_s
        self._planned, self._tracks = Moved(climb, time_s), False
        self._offset = None

    def start_track(self, time_s: float) -> None:
        """Fly the track, whose time 0 is `time_s`."""
        self._planned, self._tracks = Moved(self.track, time_s, self.origin_ned_m), True

    def follow_jump(self, time_s: float, jump_ned_m: Array) -> float:
        """Move the reference by a jump `jump_ned_m` (3,) of the estimated position, with which the
        vehicle has not moved, and from there back to its place at up to RETURN.speed_mps. Returns
        the duration of the return, s."""
        velocity = np.zeros(3)
        if self._offset is not None:
            before = self._offset.sample(time_s)
            jump_ned_m = jump_ned_m + before.position_ned_m
            velocity = before.velocity_ned_mps
        back = transfer(jump_ned_m, np.zeros(3), 0.0, 0.0, RETURN, start_velocity_ned_mps=velocity)
        self._offset = Moved(back, time_s)
        return back.duration_s

    def pause(self, time_s: float) -> None:
        """Bring the reference to rest on the track, which must have begun."""
        planned = self._planned
        assert planned is not None
        was_paused = math.isfinite(planned.paused_s)
        if was_paused and time_s < planned.resumed_s:  # still stopping: cancel `resume`
            self._planned = planned.resumed(math.inf)
            return
        if was_paused and planned.at_full_speed(time_s):
            planned = Moved(self.track, time_s - planned.own_s(time_s), self.origin_ned_m)
        self._planned = Moved(planned, paused_s=time_s)

    def resume(self, time_s: float) -> None:
        """Continue the track after `pause`."""
        assert self._planned is not None
        self._planned = self._planned.resumed(time_s)

    def place_start(
        self, position_ned_m: Triple, velocity_ned_mps: Triple, ground_down_m: float | None
    ) -> float:
        """Place the track so that it starts where a vehicle with this position and velocity can
        come to rest. Raise it until its lowest point is at least `CLEAR_M` above the ground, or not
        below the vehicle and its place of rest if the ground is not known (None). Returns by how
        much it was raised, m.
        """
        times_s = np.arange(0.0, self.track.duration_s + SAMPLED_S, SAMPLED_S)
        places = self.track.sample(times_s).position_ned_m
        rest = stopping_place(position_ned_m, velocity_ned_mps)
        origin = rest - places[0]
        lowest_m = float(origin[2]) + float(places[:, 2].max())
        least_m = max(position_ned_m[2], float(rest[2]))
        if ground_down_m is not None:
            clear_m = ground_down_m - CLEAR_M
            # a vehicle that hovers lower shows how low is safe; one that is landing does not
            least_m = clear_m if velocity_ned_mps[2] > SINKS_MPS else max(clear_m, least_m)
        above_m = max(lowest_m - least_m, 0.0)
        self.origin_ned_m = (float(origin[0]), float(origin[1]), float(origin[2]) - above_m)
        return above_m

    def track_time_s(self, time_s: float) -> float:
        """Time since the start of the track, not counting pauses; NaN before it."""
        return self._planned.own_s(time_s) if self._planned and self._tracks else math.nan

    def overdue_s(self, time_s: float) -> float:
        """Time since the planned end of the climb, s; negative before it, NaN without a climb."""
        return time_s - self._arrival_s

    def sample(self, time_s: float) -> FlatSample | None:
        """The reference at a vehicle time; None on the ground."""
        return None if self.reference is None else self.reference.sample(time_s)
