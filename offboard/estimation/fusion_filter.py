"""Kalman filter of own position fusion: the vehicle's motion, corrected by delayed GPS fixes.

Per axis [p, v, d] with v' = g e3 - T b - c v + d, where T is the commanded thrust and b the
reported attitude, which PX4's loop controls; d stands for wind and for errors of thrust and
attitude. A fix is compared with the state at its own time.
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
    """Noise and delay of the GPS receiver, drift densities per root second of the disturbance, and
    time constant and limit of the hand-over between the vehicle's estimate and our own."""

    position_sd_m: float = Field(default=0.2, gt=0, le=20)  # north and east
    height_sd_m: float = Field(default=0.5, gt=0, le=20)
    velocity_sd_mps: float = Field(default=0.08, gt=0, le=5)  # north and east
    delay_s: float = Field(default=0.0, ge=0, le=0.5)  # a receiver has 0.1 to 0.2, PX4's SIH none
    lateral_drift_mps2: float = Field(default=0.1, gt=0, le=5)
    vertical_drift_mps2: float = Field(default=0.04, gt=0, le=5)
    handover_s: float = Field(default=2.0, ge=0.2, le=20)
    disagreement_m: float = Field(default=5.0, ge=0.5, le=100)  # above: vehicle's estimate
    accuracy_m: float = Field(default=5.0, gt=0, le=100)  # less accurate fixes are dropped


class Past:
    """Values (n,) of the last REMEMBERED_S, interpolated."""

    def __init__(self) -> None:
        self._rows: deque[tuple[float, Array]] = deque()

    def note(self, time_s: float, values: Array) -> None:
        """Add the values of `time_s`, which must be newer than the last."""
        self._rows.append((time_s, values.copy()))
        while self._rows[0][0] < time_s - REMEMBERED_S:
            self._rows.popleft()

    def shift(self, change: Array) -> None:
        """Add `change` to all values."""
        for _, values in self._rows:
            values += change

    def at(self, time_s: float) -> Array | None:
        """Values at `time_s`: linear in between, constant after the newest, None before the
        oldest."""
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
    """Collective thrust (m/s^2) that the commands sent give, after delay and lag."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[float, float]] = deque(maxlen=COMMANDS_KEPT)
        self._commanded = self._now = 0.0

    def on_command(self, time_s: float, thrust_mps2: float) -> None:
        self._waiting.append((time_s, thrust_mps2))

    def rescale(self, ratio: float) -> None:
        """Rescale the commands sent to another hover thrust."""
        scaled = ((time_s, ratio * thrust) for time_s, thrust in self._waiting)
        self._waiting = deque(scaled, maxlen=COMMANDS_KEPT)
        self._commanded *= ratio
        self._now *= ratio

    def settle(self, time_s: float, vehicle: Vehicle) -> None:
        """Set the thrust to the command in force at `time_s`, without lag."""
        while self._waiting and self._waiting[0][0] + vehicle.thrust_delay_s <= time_s:
            self._commanded = self._waiting.popleft()[1]
        self._now = self._commanded

    def advance(self, begin_s: float, end_s: float, vehicle: Vehicle) -> float:
        """Mean thrust from `begin_s` to `end_s`, which must be later."""
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
        """Integral of the thrust over `step_s` under one command."""
        missing = self._now - self._commanded
        left = missing * math.exp(-step_s / lag_s) if lag_s > 0.0 else 0.0
        self._now = self._commanded + left
        return self._commanded * step_s + lag_s * (missing - left)


class Group:
    """Axes with the same covariance of [p v d]. `sd_m`: noise of a fix, `drift_mps2`: of d."""

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
        """Start with a position of variance `position_m2`."""
        start(
            self._record[0], (position_m2, START_VELOCITY_SD_MPS**2, START_DISTURBANCE_SD_MPS2**2)
        )

    def spread(self, step_s: float) -> None:
        spread(self._record, step_s)

    def explains(self, off_m: Array) -> bool:
        """Whether a difference (3,) of fix and state is within GATE_SDS standard deviations."""
        sd_m = math.sqrt(self._covariance[P, P] + self._sd_m * self._sd_m)
        return bool(np.abs(off_m[self.axes]).max() <= GATE_SDS * sd_m)

    def absorb_position(self) -> Array:
        """Correct the covariance by a fix. Returns the gain (3,)."""
        return self.absorb(P, self._sd_m * self._sd_m)

    def absorb(self, place: int, variance: float) -> Array:
        """Correct the covariance by a measurement of p, v or d. Returns the gain (3,)."""
        absorb(self._record[0], place, NOTHING, variance)
        gain: Array = self._gain[: D + 1]
        return gain


class FusionFilter:
    """Filter of all three axes: `start` it, then give it every attitude, command and fix.

    `state` (3, 3): rows north, east, down; columns [p v d].
    """

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
        """Continue with newly identified constants: the disturbance loses what the new hover thrust
        and drag explain."""
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
        """Start from `position` and `velocity` (3,), NED; `variances_m2`: of the position, lateral
        and vertical."""
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
        """Propagate the state to `time_s` with the reported thrust direction (3,)."""
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
        """Position and velocity (3,), NED, at a time close to that of the newest attitude."""
        position = self.state[:, P] + (time_s - self.time_s) * self.state[:, V]
        return position, self.state[:, V].copy()

    def correct(
        self, time_s: float, position: Array, velocity_ne: tuple[float, float] | None
    ) -> Array | None:
        """Correct by a fix of `time_s`. Returns the change of position and velocity (3, 2), or None
        if the fix is an outlier or older than REMEMBERED_S."""
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
