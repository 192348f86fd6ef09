"""A reference that is paused: its own time slows down smoothly to a stop, and later runs again.

The path stays the same, and its derivatives remain continuous to snap: the vehicle comes to rest on
the path, and leaves it from there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from offboard.reference.base import FlatSample, Reference
from offboard.reference.warp import compose_heading, compose_position, warp

Array = NDArray[np.float64]

STOP_S = 2.5  # from full speed to rest, and back; about the acceleration of a run-out
_BEFORE_S = 1e6  # of undisturbed time, more than a flight lasts


@dataclass(frozen=True, slots=True)
class Paused:
    """`reference`, paused from `began_s`, and again running from `resumed_s`.

    Args:
        reference: any reference.
        began_s: on its time axis, when it begins to stop; at rest `STOP_S` later.
        resumed_s: when it begins to run again, not before it is at rest.
    """

    reference: Reference
    began_s: float
    resumed_s: float = math.inf

    @property
    def duration_s(self) -> float:
        """The end, on the new axis; infinite while it is paused."""
        lost_s = self.resumed_s - self.began_s  # a stop and a start cover a half of their time each
        return self.reference.duration_s + lost_s

    def resumed(self, time_s: float) -> Paused:
        """Running again from `time_s`, or from the moment when it has come to rest."""
        return replace(self, resumed_s=max(time_s, self.began_s + STOP_S))

    def passed_s(self, time_s: float) -> float:
        """The reference's own time at `time_s`."""
        if isinstance(self.reference, Paused):
            return self.reference.passed_s(float(self._own(np.array([time_s]))[0, 0]))
        return float(self._own(np.array([time_s]))[0, 0])

    def at_full_speed(self, time_s: float) -> bool:
        """Whether it runs again as fast as before, from `time_s` on."""
        return time_s >= self.resumed_s + STOP_S

    def sample(self, time_s: float | Array) -> FlatSample:
        """Flat outputs at `time_s`, a scalar or an array of any shape."""
        time = np.asarray(time_s, dtype=np.float64)
        own = self._own(time.reshape(-1))
        inner = self.reference.sample(own[0])
        position = compose_position(
            own,
            np.stack(
                [
                    inner.position_ned_m,
                    inner.velocity_ned_mps,
                    inner.acceleration_ned_mps2,
                    inner.jerk_ned_mps3,
                    inner.snap_ned_mps4,
                ]
            ),
        )
        heading = compose_heading(
            own,
            np.stack(
                [inner.heading_rad, inner.heading_rate_radps, inner.heading_acceleration_radps2]
            ),
        )
        return FlatSample(
            *(derivative.reshape(*time.shape, 3) for derivative in position),
            *(derivative.reshape(time.shape) for derivative in heading),
        )

    def _own(self, time_s: Array) -> Array:
        """The reference's own time and its first four derivatives (5, N) at `time_s` (N,)."""
        own = warp(time_s - self.began_s + _BEFORE_S, 0.0, _BEFORE_S, STOP_S)
        own[0] += self.began_s - _BEFORE_S
        again = time_s >= self.resumed_s
        if again.any():
            rest_s = self.began_s + 0.5 * STOP_S
            own[:, again] = warp(time_s[again] - self.resumed_s, STOP_S, _BEFORE_S, 0.0)
            own[0, again] += rest_s
        return own
