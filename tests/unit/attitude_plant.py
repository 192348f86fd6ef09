"""A vehicle behind an autopilot's attitude loop, for tests; independent of observer and law.

The tilt loop is of second order with delay and a limit on its angular acceleration and closes on
the autopilot's *estimate*; thrust lags; drag; and the estimate errs as PX4's does on its SIH
simulator, e' = A e + w per axis with true tilt = estimated - e_b. Integrated in steps of 1 ms.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numba
import numpy as np

from offboard.control.base import Controller, Situation
from offboard.estimation.noise import Noise
from offboard.estimation.observer import Observer
from offboard.model.command import Command
from offboard.model.frames import quaternion_from_thrust_direction
from offboard.model.vehicle import Vehicle
from offboard.reference.base import FlatSample

STEP_S = 1e-3

# e = [e_p, e_v, e_b] north and east, [e_p, e_v] down; densities per root second.
DRIFT_NORTH = np.array([[-0.06, 0.13, -0.55], [-0.06, -0.135, -2.6], [-0.006, 0.029, -0.0175]])
DRIFT_EAST = np.array([[-0.34, 0.30, -0.78], [-0.28, -0.06, -4.5], [-0.014, 0.026, 0.008]])
DRIFT_DOWN = np.array([[-0.05, 0.36, 0.0], [-0.02, -0.07, 0.0], [0.0, 0.0, 0.0]])
DRIFTS = np.stack([DRIFT_NORTH, DRIFT_EAST, DRIFT_DOWN])
DENSITIES = np.array([[0.030, 0.044, 0.010], [0.0225, 0.097, 0.012], [0.013, 0.082, 0.0]])
# Sample to sample: position, velocity, attitude.
WHITE_SDS = np.array([0.0003, 0.004, 0.0005])
# Septic smooth step of the path's speed, highest power first, its derivatives and integral.
SPEED = [np.polyder(np.array([-20, 70, -84, 35, 0, 0, 0, 0]), k) for k in range(4)]
SPEED_INTEGRAL = np.polyint(SPEED[0])
GAPS_S = (0.008, 0.008, 0.008, 0.016)


@dataclass
class Truth:
    """What the plant really is; `thrust_scale` is true over believed thrust."""

    vehicle: Vehicle
    thrust_scale: float = 1.0
    wind_force_ned_mps2: tuple[float, float, float] = (0.0, 0.0, 0.0)
    extra_delay_s: float = 0.0
    noisy: bool = True


@numba.njit(cache=True)
def _run(x, errors, commands, walks, drifts, constants, wind):
    """x = [p (3), v (3), b_est (2), b_est' (2), T, psi, psi'], commands (n, 4) = [b_n, b_e, T,
    heading], one row per step; errors (3, 3) as DRIFTS; walks (n, 3, 3) their increments."""
    g, c, wn, z, lag, wy, zy, limit = constants
    h = STEP_S
    for i in range(len(commands)):
        bn, be = x[6] - errors[0, 2], x[7] - errors[1, 2]
        down = np.sqrt(1.0 - bn * bn - be * be)
        x[10] += (commands[i, 2] - x[10]) * (1.0 - np.exp(-h / lag) if lag > 0 else 1.0)
        acceleration = (-x[10] * bn, -x[10] * be, g - x[10] * down)
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
        for axis in range(3):
            errors[axis] += h * (drifts[axis] @ errors[axis]) + walks[i, axis]


@dataclass
class Plant:
    truth: Truth
    rng: np.random.Generator
    time_s: float = 0.0
    x: np.ndarray = field(default_factory=lambda: np.zeros(13))
    errors: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))

    def __post_init__(self) -> None:
        vehicle = self.truth.vehicle
        self.sent = np.empty((0, 5))  # time, b_n, b_e, thrust, heading
        if self.x[10] == 0.0:
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
        steps = round(interval_s / STEP_S)
        times = self.time_s + STEP_S * np.arange(steps) - self.truth.extra_delay_s
        vehicle = self.truth.vehicle
        rows = np.empty((steps, 4))
        rows[:, :2] = self._in_force(times - vehicle.tilt.delay_s)[:, 1:3]
        thrust = self._in_force(times - vehicle.thrust_delay_s)[:, 3]
        rows[:, 2] = self.truth.thrust_scale * thrust
        rows[:, 3] = self._in_force(times - vehicle.yaw.delay_s)[:, 4]
        walks = np.zeros((steps, 3, 3))
        drifts = np.zeros((3, 3, 3))
        if self.truth.noisy:
            walks = self.rng.normal(size=walks.shape) * DENSITIES * np.sqrt(STEP_S)
            drifts = DRIFTS
        wind = np.array(self.truth.wind_force_ned_mps2)
        _run(self.x, self.errors, rows, walks, drifts, self.constants, wind)
        self.time_s = round((self.time_s + interval_s) / STEP_S) * STEP_S

    def _in_force(self, times: np.ndarray) -> np.ndarray:
        """Rows of `sent` that act at `times`, the first one for ever before."""
        rows = np.searchsorted(self.sent[:, 0], times + 1e-9, side="right") - 1
        return self.sent[np.maximum(rows, 0)]

    def position(self) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity as the autopilot reports them."""
        white = self.rng.normal(size=6) * self.truth.noisy
        position = self.x[:3] + self.errors[:, 0] + WHITE_SDS[0] * white[:3]
        return position, self.x[3:6] + self.errors[:, 1] + WHITE_SDS[1] * white[3:]

    def attitude(self) -> np.ndarray:
        """The estimated attitude, FRD -> NED."""
        tilt = self.x[6:8] + WHITE_SDS[2] * self.truth.noisy * self.rng.normal(size=2)
        direction = np.array([tilt[0], tilt[1], np.sqrt(1.0 - tilt @ tilt)])
        return quaternion_from_thrust_direction(direction, self.x[11])


@dataclass
class Lemniscate:
    """2 sin wt north, 1 sin 2wt east, 3 m high, heaving with sin 3wt; from rest over the first
    `run_in_s`."""

    period_s: float
    run_in_s: float = 4.0
    heading_rad: float = 0.0
    heave_m: float = 0.0

    @property
    def duration_s(self) -> float:
        return 3600.0

    def sample(self, time_s: float | np.ndarray) -> FlatSample:
        time = np.asarray(time_s, dtype=np.float64)
        omega = 2.0 * np.pi / self.period_s
        phase = _run_in(time, self.run_in_s)
        north = _composed(2.0, omega, phase)
        east = _composed(1.0, 2.0 * omega, phase)
        down = _composed(self.heave_m, 3.0 * omega, phase)
        down[0] = down[0] - 3.0
        derivatives = []
        for order in range(5):
            derivatives.append(np.stack([north[order], east[order], down[order]], axis=-1))
        zero = np.zeros_like(time)
        return FlatSample(*derivatives, zero + self.heading_rad, zero, zero)


def _run_in(time: np.ndarray, run_in_s: float) -> list[np.ndarray]:
    """Path time and its derivatives to the fourth: speed 0 -> 1 by a septic smooth step."""
    u = np.clip(time / run_in_s, 0.0, 1.0)
    path = np.polyval(SPEED_INTEGRAL, u) * run_in_s + np.maximum(time - run_in_s, 0.0)
    return [path] + [np.polyval(SPEED[k], u) / run_in_s**k for k in range(4)]


def _composed(amplitude: float, omega: float, phase: list[np.ndarray]) -> list[np.ndarray]:
    """a sin(w s(t)) and its first four time derivatives (Faa di Bruno)."""
    s, s1, s2, s3, s4 = phase
    f = [amplitude * omega**k * np.sin(omega * s + 0.5 * np.pi * k) for k in range(5)]
    return [
        f[0],
        f[1] * s1,
        f[2] * s1**2 + f[1] * s2,
        f[3] * s1**3 + 3 * f[2] * s1 * s2 + f[1] * s3,
        f[4] * s1**4 + 6 * f[3] * s1**2 * s2 + f[2] * (3 * s2**2 + 4 * s1 * s3) + f[1] * s4,
    ]


@dataclass
class Flight:
    """What a flight left: RMSE and largest error (estimate against reference, 3D) after the
    run-in, the observer, and how agitated the vehicle was."""

    rmse_m: float
    largest_m: float
    rate_sd_radps: float
    observer: Observer
    at_bound: float
    end_s: float


def fly(
    truth: Truth,
    controller: Controller,
    believed: Vehicle,
    reference: Lemniscate,
    seed: int,
    noise: Noise | None = None,
    laps: float = 2.0,
    period_s: float = 0.1,
    score_from_s: float = 8.0,
    offset_ned_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gaps_s: tuple[float, ...] = GAPS_S,
) -> Flight:
    """Fly `reference` from rest at its start; decisions at multiples of `period_s`."""
    plant = Plant(truth, np.random.default_rng(seed))
    plant.x[:3] = reference.sample(0.0).position_ned_m + np.array(offset_ned_m)
    plant.x[10] = believed.gravity_mps2
    observer = Observer(believed, noise)
    command = Command(believed.gravity_mps2, (0.0, 0.0, 1.0), reference.heading_rad)
    plant.command(command)
    observer.on_command(0.0, command)
    times, positions, rates, bounds = [], [], [], []
    next_decision_s, message = period_s, 0
    while plant.time_s < score_from_s + laps * reference.period_s:
        plant.advance(gaps_s[message % len(gaps_s)])
        message += 1
        now = plant.time_s
        observer.on_attitude(now, plant.attitude(), np.zeros(3))
        position, velocity = plant.position()
        observer.on_position(now, position, velocity)
        if now >= score_from_s:
            times.append(now)
            positions.append(position)
            rates.append(plant.x[8:10].copy())
        if now >= next_decision_s - 1e-9:
            next_decision_s = (np.floor(now / period_s + 1e-6) + 1) * period_s
            situation = Situation(now, observer.predict(now), reference, command)
            decision = controller.decide(situation)
            command = decision.command
            bounds.append(decision.certificate.at_bound)
            observer.on_command(now, command)
            plant.command(command)
    wanted = reference.sample(np.array(times)).position_ned_m
    distances = np.linalg.norm(positions - wanted, axis=1)
    return Flight(
        rmse_m=float(np.sqrt(np.mean(distances**2))),
        largest_m=float(distances.max()),
        rate_sd_radps=float(np.std(np.array(rates)[:, 0])),
        observer=observer,
        at_bound=float(np.mean(bounds)),
        end_s=now,
    )
