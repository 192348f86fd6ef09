"""A vehicle behind an autopilot's attitude loop, written independently of observer and law.

The tilt loop is of second order with a delay and a limit on angular acceleration; the thrust has a
delay and a first-order lag; drag is linear. Steps are 1 ms. The telemetry has no errors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numba
import numpy as np

from offboard.control.base import Controller, Situation
from offboard.estimation.noise import Noise
from offboard.estimation.observer import Observer
from offboard.model.command import Command
from offboard.model.frames import quaternion_from_thrust_direction
from offboard.model.vehicle import Vehicle
from offboard.reference.base import Reference
from offboard.reference.path import Harmonic, Sine
from offboard.reference.track import Track

STEP_S = 1e-3
GAPS_S = (0.008, 0.008, 0.008, 0.016)  # between messages of PX4's telemetry


@dataclass
class Truth:
    """The plant's true constants; `thrust_scale` is its thrust divided by the commanded thrust."""

    vehicle: Vehicle
    thrust_scale: float = 1.0
    wind_force_ned_mps2: tuple[float, float, float] = (0.0, 0.0, 0.0)
    extra_delay_s: float = 0.0


@numba.njit(cache=True)
def _run(x, commands, constants, wind):
    """Integrate x = [p (3), v (3), b (2), b' (2), T, psi, psi'] in place, one step for each row of
    `commands` (n, 4) = [b_n, b_e, T, heading]."""
    g, c, wn, z, lag, wy, zy, limit = constants
    h = STEP_S
    for i in range(len(commands)):
        down = np.sqrt(1.0 - x[6] ** 2 - x[7] ** 2)
        x[10] += (commands[i, 2] - x[10]) * (1.0 - np.exp(-h / lag) if lag > 0 else 1.0)
        acceleration = (-x[10] * x[6], -x[10] * x[7], g - x[10] * down)
        for axis in range(3):
            a = acceleration[axis] - c * x[3 + axis] + wind[axis]
            x[axis] += h * x[3 + axis] + 0.5 * h * h * a
            x[3 + axis] += h * a
        for axis in range(2):
            twist = wn * wn * (commands[i, axis] - x[6 + axis]) - 2.0 * z * wn * x[8 + axis]
            twist = min(max(twist, -limit), limit)
            x[6 + axis] += h * x[8 + axis] + 0.5 * h * h * twist
            x[8 + axis] += h * twist
        turn = wy * wy * (commands[i, 3] - x[11]) - 2.0 * zy * wy * x[12]
        x[11] += h * x[12]
        x[12] += h * turn


@dataclass
class Plant:
    truth: Truth
    time_s: float = 0.0
    x: np.ndarray = field(default_factory=lambda: np.zeros(13))

    def __post_init__(self) -> None:
        self.sent = np.empty((0, 5))  # time, b_n, b_e, thrust, heading
        vehicle = self.truth.vehicle
        self.x[10] = vehicle.gravity_mps2
        self.constants = (
            vehicle.gravity_mps2,
            vehicle.drag_per_mass_ps,
            vehicle.tilt.natural_frequency_radps,
            vehicle.tilt.damping,
            vehicle.thrust_lag_s,
            vehicle.yaw.natural_frequency_radps,
            vehicle.yaw.damping,
            vehicle.angular_acceleration_limit_radps2[0],
        )

    def command(self, command: Command) -> None:
        north, east, _ = command.thrust_direction_ned
        sent = (self.time_s, north, east, command.thrust_mps2, command.heading_rad)
        self.sent = np.vstack((self.sent[-30:], sent))

    def advance(self, interval_s: float) -> None:
        steps, vehicle = round(interval_s / STEP_S), self.truth.vehicle
        times = self.time_s + STEP_S * np.arange(steps) - self.truth.extra_delay_s
        rows = np.empty((steps, 4))
        rows[:, :2] = self._in_force(times - vehicle.tilt.delay_s)[:, 1:3]
        thrust = self._in_force(times - vehicle.thrust_delay_s)[:, 3]
        rows[:, 2] = self.truth.thrust_scale * thrust
        rows[:, 3] = self._in_force(times - vehicle.yaw.delay_s)[:, 4]
        _run(self.x, rows, self.constants, np.array(self.truth.wind_force_ned_mps2))
        self.time_s = round((self.time_s + interval_s) / STEP_S) * STEP_S

    def _in_force(self, times: np.ndarray) -> np.ndarray:
        """Rows of `sent` that are in force at `times`; before the first command, the first row."""
        rows = np.searchsorted(self.sent[:, 0], times + 1e-9, side="right") - 1
        return self.sent[np.maximum(rows, 0)]

    def position(self) -> tuple[np.ndarray, np.ndarray]:
        """Return position and velocity, NED."""
        return self.x[:3].copy(), self.x[3:6].copy()

    def attitude(self) -> np.ndarray:
        """Attitude quaternion, FRD -> NED."""
        down = np.sqrt(1.0 - self.x[6] ** 2 - self.x[7] ** 2)
        return quaternion_from_thrust_direction(np.array([*self.x[6:8], down]), self.x[11])


def lemniscate(period_s: float, *, heading_rad: float = 0.0, vertical_m: float = 0.0) -> Track:
    """A track of 2 sin wt north, 1 sin 2wt east, `vertical_m` sin 3wt down about a height of 3 m.
    It begins at rest and reaches full speed in 4 s."""
    omega = math.tau / period_s
    sine = Sine((2.0, 1.0, vertical_m), (omega, 2.0 * omega, 3.0 * omega))
    path = Harmonic(3600.0, sines=(sine,))
    return Track(path, heading_rad, run_in_s=4.0, origin_ned_m=(0.0, 0.0, -3.0))


def fly(
    truth: Truth,
    controller: Controller,
    believed: Vehicle,
    reference: Reference,
    seconds: float,
    *,
    noise: Noise | None = None,
    score_from_s: float = 8.0,
    offset_ned_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gaps_s: tuple[float, ...] = GAPS_S,
) -> float:
    """Fly `reference` from rest at its start with a decision every 0.1 s. Return the RMSE of the
    position in m from `score_from_s` on."""
    plant, observer, start = Plant(truth), Observer(believed, noise), reference.sample(0.0)
    plant.x[:3] = start.position_ned_m + np.array(offset_ned_m)
    command = Command(believed.gravity_mps2, (0.0, 0.0, 1.0), float(start.heading_rad))
    plant.command(command)
    observer.on_command(0.0, command)
    times, positions, decided, message = [], [], 0, 0
    while plant.time_s < seconds:
        plant.advance(gaps_s[message % len(gaps_s)])
        message += 1
        now, (position, velocity) = plant.time_s, plant.position()
        observer.on_attitude(now, plant.attitude(), np.zeros(3))
        observer.on_position(now, position, velocity)
        if now >= score_from_s:
            times.append(now)
            positions.append(position)
        if math.floor(10.0 * now + 1e-6) > decided:
            decided = math.floor(10.0 * now + 1e-6)
            situation = Situation(now, observer.predict(now), reference, command)
            command = controller.decide(situation).command
            observer.on_command(now, command)
            plant.command(command)
    off = positions - reference.sample(np.array(times)).position_ned_m
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
