"""Position and velocity by the model, corrected by fixes that come late: what fusion computes.

Per axis [p, v, d]: v' = g e3 - T b - c v + d with the thrust commanded and the attitude reported,
which PX4's loop closes on; d takes up wind, wrong thrust and the attitude's own error. A fix is
compared with the state of its own time. Knows no messages, no origin and no other estimate.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from offboard.documents.parameters import Parameters
from offboard.estimation.filtering import FILTER, NOTHING, absorb, set_up, spread, start
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]
Triple = tuple[float, float, float]

P, V, D = 0, 1, 2
LATERAL, VERTICAL = slice(0, 2), slice(2, 3)
START_VELOCITY_SD_MPS, START_DISTURBANCE_SD_MPS2 = 0.3, 0.5
GATE_SDS = 5.0
LONGEST_SPREAD_S = 0.05
COMMANDS_KEPT = 128
REMEMBERED_S = 0.6  # a fix older than this is not used


class FusionSettings(Parameters):
    """Receiver: standard deviations of a fix, and how much older than its stamp it is. Model: noise
    densities per root second. Switching between the estimates: how fast, and how far apart they
    may be."""

    position_sd_m: float = Field(default=0.2, gt=0, le=20)  # north and east
    height_sd_m: float = Field(default=0.5, gt=0, le=20)
    velocity_sd_mps: float = Field(default=0.08, gt=0, le=5)  # north and east
    delay_s: float = Field(default=0.0, ge=0, le=0.5)  # receivers: 0.1 to 0.2; PX4's SIH: none
    lateral_drift_mps2: float = Field(default=0.1, gt=0, le=5)
    vertical_drift_mps2: float = Field(default=0.04, gt=0, le=5)
    handover_s: float = Field(default=2.0, ge=0.2, le=20)
    disagreement_m: float = Field(default=5.0, ge=0.5, le=100)  # then the vehicle's estimate counts
    accuracy_m: float = Field(default=5.0, gt=0, le=100)  # a fix that claims less is not used


class Past:
    """Values (n,) of the last moments, and what they were in between."""

    def __init__(self) -> None:
        self._rows: deque[tuple[float, Array]] = deque()

    def note(self, time_s: float, values: Array) -> None:
        """Times rise; what is older than REMEMBERED_S is forgotten."""
        self._rows.append((time_s, values.copy()))
        while self._rows[0][0] < time_s - REMEMBERED_S:
            self._rows.popleft()

    def shift(self, change: Array) -> None:
        """All of it was so much different."""
        for _, values in self._rows:
            values += change

    def at(self, time_s: float) -> Array | None:
        """Linear between two moments, held behind the newest; None before the oldest."""
        later: tuple[float, Array] | None = None
        for row in reversed(self._rows):
            if row[0] <= time_s:
                if later is None:
                    return row[1]
                share = (time_s - row[0]) / (later[0] - row[0])
                between: Array = row[1] + share * (later[1] - row[1])
                return between
            later = row
        return None


class Thrust:
    """The collective thrust, m/s^2, that the commands sent give: each after its delay and lag."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[float, float]] = deque(maxlen=COMMANDS_KEPT)
        self._commanded = self._now = 0.0

    def on_command(self, time_s: float, thrust_mps2: float) -> None:
        self._waiting.append((time_s, thrust_mps2))

    def rescale(self, ratio: float) -> None:
        """The same commands on the scale of another hover thrust."""
        scaled = ((time_s, ratio * thrust) for time_s, thrust in self._waiting)
        self._waiting = deque(scaled, maxlen=COMMANDS_KEPT)
        self._commanded *= ratio
        self._now *= ratio

    def settle(self, time_s: float, vehicle: Vehicle) -> None:
        """What acts at `time_s` has acted for long."""
        while self._waiting and self._waiting[0][0] + vehicle.thrust_delay_s <= time_s:
            self._commanded = self._waiting.popleft()[1]
        self._now = self._commanded

    def advance(self, begin_s: float, end_s: float, vehicle: Vehicle) -> float:
        """The mean over the interval, which is not empty."""
        time_s, area = begin_s, 0.0
        while time_s < end_s:
            until_s = end_s
            if self._waiting:
                acts_s = self._waiting[0][0] + vehicle.thrust_delay_s
                if acts_s <= time_s:
                    self._commanded = self._waiting.popleft()[1]
                    continue
                until_s = min(acts_s, end_s)
            area += self._hold(until_s - time_s, vehicle.thrust_lag_s)
            time_s = until_s
        return area / (end_s - begin_s)

    def _hold(self, step_s: float, lag_s: float) -> float:
        """The integral while one command is in force."""
        missing = self._now - self._commanded
        left = missing * math.exp(-step_s / lag_s) if lag_s > 0.0 else 0.0
        self._now = self._commanded + left
        return self._commanded * step_s + lag_s * (missing - left)


class Group:
    """Axes that share a model: their covariance [p v d]. `sd_m` of a fix, `drift_mps2` of d."""

    def __init__(self, axes: slice, sd_m: float, drift_mps2: float) -> None:
        self.axes = axes
        self._sd_m = sd_m
        self._densities = np.array([0.0, 0.2 * drift_mps2, drift_mps2])
        self._record = np.zeros(1, FILTER).view(np.recarray)
        self._record["longest_s"] = LONGEST_SPREAD_S
        self._covariance, self._gain = self._record["covariance"][0], self._record["gain"][0]

    def adopt(self, drag_per_mass_ps: float) -> None:
        dynamics = np.zeros((3, 3))
        dynamics[P, V] = dynamics[V, D] = 1.0
        dynamics[V, V] = -drag_per_mass_ps
        set_up(self._record[0], dynamics, self._densities)

    def start(self, position_m2: float) -> None:
        """From a position of this variance."""
        start(
            self._record[0], (position_m2, START_VELOCITY_SD_MPS**2, START_DISTURBANCE_SD_MPS2**2)
        )

    def spread(self, step_s: float) -> None:
        spread(self._record, step_s)

    def explains(self, off_m: Array) -> bool:
        """Whether a fix may be off by so much by chance."""
        sd_m = math.sqrt(self._covariance[P, P] + self._sd_m * self._sd_m)
        return bool(np.abs(off_m[self.axes]).max() <= GATE_SDS * sd_m)

    def absorb_position(self) -> Array:
        """Take in a fix: its gain (3,)."""
        return self.absorb(P, self._sd_m * self._sd_m)

    def absorb(self, place: int, variance: float) -> Array:
        """Take in a measurement of p, v or d: its gain (3,)."""
        absorb(self._record[0], place, NOTHING, variance)
        gain: Array = self._gain[: D + 1]
        return gain


class FusionFilter:
    """`start` it, then feed it every attitude, command and fix. state (3, 3): axes NED, [p v d]."""

    def __init__(self, vehicle: Vehicle, settings: FusionSettings) -> None:
        self._settings = settings
        self._lateral = Group(LATERAL, settings.position_sd_m, settings.lateral_drift_mps2)
        vertical = Group(VERTICAL, settings.height_sd_m, settings.vertical_drift_mps2)
        self._groups = self._lateral, vertical
        self._thrust = Thrust()
        self.state = np.zeros((3, 3))
        self.time_s = -math.inf
        self._past = Past()
        self._adopt(vehicle)

    def adopt(self, vehicle: Vehicle) -> None:
        """Go on with a newly identified vehicle: the disturbance gives up what the new hover thrust
        and the new drag explain."""
        ratio = self._vehicle.hover_thrust / vehicle.hover_thrust
        slowed = vehicle.drag_per_mass_ps - self._vehicle.drag_per_mass_ps
        gravity = self._vehicle.gravity_mps2
        self._thrust.rescale(ratio)
        self.state[2, D] = (gravity + self.state[2, D]) * ratio - vehicle.gravity_mps2
        self.state[:, D] += slowed * self.state[:, V]
        self._adopt(vehicle)

    def start(
        self, time_s: float, position: Array, velocity: Array, variances_m2: tuple[float, float]
    ) -> None:
        """From here, NED; `variances_m2` of the position, lateral and vertical."""
        self.time_s = time_s
        self.state[:, P], self.state[:, V], self.state[:, D] = position, velocity, 0.0
        for group, variance_m2 in zip(self._groups, variances_m2, strict=True):
            group.start(variance_m2)
        self._direction: Array | None = None
        self._past = Past()
        self._past.note(time_s, self.state[:, :D])
        self._thrust.settle(time_s, self._vehicle)

    def on_command(self, time_s: float, thrust_mps2: float) -> None:
        self._thrust.on_command(time_s, thrust_mps2)

    def on_attitude(self, time_s: float, direction_ned: Array) -> None:
        """The reported thrust direction (3,): the state moves on to its time."""
        step_s = time_s - self.time_s
        if step_s <= 0.0:
            return
        before = direction_ned if self._direction is None else self._direction
        thrust = self._thrust.advance(self.time_s, time_s, self._vehicle)
        self._direction = direction_ned
        pull = -0.5 * thrust * (before + direction_ned)
        pull[2] += self._vehicle.gravity_mps2
        acceleration = pull + self.state[:, D] - self._vehicle.drag_per_mass_ps * self.state[:, V]
        self.state[:, P] += step_s * (self.state[:, V] + 0.5 * step_s * acceleration)
        self.state[:, V] += step_s * acceleration
        for group in self._groups:
            group.spread(step_s)
        self.time_s = time_s
        self._past.note(time_s, self.state[:, :D])

    def at(self, time_s: float) -> tuple[Array, Array]:
        """Position and velocity (3,), NED, at a time close to the newest attitude's."""
        position = self.state[:, P] + (time_s - self.time_s) * self.state[:, V]
        return position, self.state[:, V].copy()

    def correct(
        self, time_s: float, position: Array, velocity_ne: tuple[float, float] | None
    ) -> Array | None:
        """Take in a fix of `time_s`: how position and velocity (3, 2) changed by it; None where it
        is further off than chance explains, or older than what is remembered."""
        then = self._past.at(time_s)
        if then is None:
            return None
        off = position - then[:, P]
        if not all(group.explains(off) for group in self._groups):
            return None
        before = self.state[:, :D].copy()
        for group in self._groups:
            self.state[group.axes] += np.outer(off[group.axes], group.absorb_position())
        if velocity_ne is not None:
            moved = self.state[LATERAL, V] - before[LATERAL, V]
            slower = np.array(velocity_ne) - then[LATERAL, V] - moved
            gain = self._lateral.absorb(V, self._settings.velocity_sd_mps**2)
            self.state[LATERAL] += np.outer(slower, gain)
        change: Array = self.state[:, :D] - before
        self._past.shift(change)
        return change

    def _adopt(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        for group in self._groups:
            group.adopt(vehicle.drag_per_mass_ps)
