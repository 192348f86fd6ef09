"""One flight of the paper's loop: reference, law and plant, with a certificate for every step.

The paper draws its path (Figs. 5 and 6) without numbers; this one is similar: about 100 s at some
3 m/s through turns and changes of height, minimum snap from rest to rest, the nose along the path.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from enum import StrEnum
from functools import cache

import numpy as np
from numpy.typing import NDArray

from offboard.control.quadratic import ExactMinimum
from offboard.control.swarm import certify
from offboard.link.clock import monotonic_s
from offboard.model.command import PredictedState
from offboard.model.frames import quaternion_from_euler, rotation_from_quaternion
from offboard.model.rigid_body import EULER, PHI, PSI, THETA, THRUST, P, R, U, V, W, X, Z
from offboard.model.vehicle import Vehicle
from offboard.paper.controller import flyable_box, heading_frame
from offboard.paper.law import INTEGRATED, PAPER_STEP_S, PaperLaw, PaperSettings
from offboard.paper.plant import (
    LinearPlant,
    NonlinearPlant,
    PlantKind,
    paper_model,
    paper_vehicle,
)
from offboard.reference.base import FlatSample
from offboard.reference.flatness import flat_state
from offboard.reference.path import Smoothness
from offboard.reference.shapes import HeadingMode, Hover, Waypoints

Array = NDArray[np.float64]

HOVER = Hover(height_m=2.0, duration_s=60.0)
TOUR = Waypoints(
    points_m=(
        (0.0, 0.0, 2.0), (20.0, 5.0, 2.0), (30.0, 25.0, 4.0), (10.0, 40.0, 6.0),
        (-15.0, 30.0, 6.0), (-25.0, 0.0, 4.0), (-10.0, -30.0, 4.0), (20.0, -40.0, 3.0),
        (45.0, -20.0, 2.0), (50.0, 10.0, 2.0),
    ),
    speed_mps=2.8,  # mean of an inner leg
    minimise=Smoothness.SNAP,
    course=HeadingMode.ALONG_VELOCITY,
)  # fmt: skip


class PathName(StrEnum):
    """The references of the study."""

    TOUR = "tour"  # Figs. 5 and 6
    HOVER = "hover"


@cache
def sampled_path(name: PathName, steps: int) -> tuple[FlatSample, Array]:
    """A reference at k = 0 ... `steps`: flat outputs, and the states (steps + 1, 12) of Eq. 27:
    zero except psi, u, v, w, x, y, z, with velocities in NED as on the linear plant."""
    reference = (HOVER if name is PathName.HOVER else TOUR).track()
    samples = reference.sample(PAPER_STEP_S * np.arange(steps + 1, dtype=np.float64))
    tracked = np.zeros((steps + 1, 12))
    tracked[:, PSI] = samples.heading_rad
    tracked[:, U : W + 1] = samples.velocity_ned_mps
    tracked[:, X : Z + 1] = samples.position_ned_m
    return samples, tracked


def linear_states(samples: FlatSample, vehicle: Vehicle) -> Array:
    """All states (..., 12) of the linear model when it follows the reference exactly."""
    gravity, drag = vehicle.gravity_mps2, vehicle.drag_per_mass_ps
    v, a, j = samples.velocity_ned_mps, samples.acceleration_ned_mps2, samples.jerk_ned_mps3
    states = np.zeros((*samples.heading_rad.shape, 12))
    lean = (a + drag * v) / gravity  # u' = -g theta - c u, v' = g phi - c v
    lean_rate = (j + drag * a) / gravity
    states[..., PHI], states[..., THETA] = lean[..., 1], -lean[..., 0]
    states[..., P], states[..., P + 1] = lean_rate[..., 1], -lean_rate[..., 0]
    states[..., PSI], states[..., R] = samples.heading_rad, samples.heading_rate_radps
    states[..., U : W + 1] = v
    states[..., X : Z + 1] = samples.position_ned_m
    return states


def heading_states(samples: FlatSample, vehicle: Vehicle) -> Array:
    """The same (..., 12) for the nonlinear plant (flatness), in the heading frame of each sample;
    heading and position are relative to the sample, hence 0."""
    flat = flat_state(samples, vehicle.gravity_mps2, vehicle.drag_per_mass_ps)
    cosine, sine = np.cos(samples.heading_rad), np.sin(samples.heading_rad)
    b, v = flat.thrust_direction_ned, samples.velocity_ned_mps
    along = cosine * b[..., 0] + sine * b[..., 1]
    across = cosine * b[..., 1] - sine * b[..., 0]
    states = np.zeros((*samples.heading_rad.shape, 12))
    states[..., PHI], states[..., THETA] = np.arcsin(-across), np.arctan2(along, b[..., 2])
    states[..., P : R + 1] = flat.rates_frd_radps
    states[..., U] = cosine * v[..., 0] + sine * v[..., 1]
    states[..., V] = cosine * v[..., 1] - sine * v[..., 0]
    states[..., W] = v[..., 2]
    return states


def nominal_inputs(states: Array, samples: FlatSample, vehicle: Vehicle, tilted: bool) -> Array:
    """Inputs (K, 4) held between states (K + 1, 12); torques follow from the rates at both ends.

    `tilted`: increase the thrust by the part that tilt turns sideways, which the linear model
    neglects.
    """
    inertia, drag = np.array(vehicle.inertia_kgm2), np.array(vehicle.drag_rotation_nmpradps)
    rates = states[:, P : R + 1]
    inputs = np.empty((len(states) - 1, 4))
    inputs[:, 1:] = inertia * np.diff(rates, axis=0) / PAPER_STEP_S
    inputs[:, 1:] += 0.5 * drag * (rates[1:] + rates[:-1])
    inputs[:, 1:3] /= vehicle.arm_m
    upward = -(samples.acceleration_ned_mps2 + vehicle.drag_per_mass_ps * samples.velocity_ned_mps)
    b_z = np.cos(states[:, PHI]) * np.cos(states[:, THETA]) if tilted else 1.0
    lift = vehicle.mass_kg * (vehicle.gravity_mps2 + upward[:, 2]) / b_z
    inputs[:, THRUST] = 0.5 * (lift[1:] + lift[:-1]) - vehicle.mass_kg * vehicle.gravity_mps2
    return inputs


TRACKED = (*range(U, Z + 1), PSI)  # Eq. 31, in the order of Tables 3 and 4: u v w x y z psi


class LawName(StrEnum):
    """The laws compared."""

    ONE_STEP = "one step"  # Eq. 21
    COST_TO_GO = "cost-to-go"  # the Riccati solution replaces Q; the reference is consistent


@dataclass(frozen=True, slots=True)
class FlightTask:
    """`start_offset_m` is the start relative to the reference's start, NED; `thrust_loss` the
    missing fraction of the total thrust."""

    settings: PaperSettings
    plant: PlantKind = PlantKind.LINEAR
    path: PathName = PathName.TOUR
    law: LawName = LawName.ONE_STEP
    steps: int = 1000
    wind_ned_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    thrust_loss: float = 0.0
    start_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Flight:
    """K steps. `states` and the reference `tracked` (K + 1, 12) with velocities u, v, w in NED;
    `inputs` (K, 4) relative to hover. Per step (K,): `costs` J and their part weighed by R and
    R_du, `spreads` epsilon, `gaps` to the exact optimum, `solve_s`.
    """

    states: Array
    tracked: Array
    inputs: Array
    costs: Array
    signal_costs: Array
    spreads: Array
    gaps: Array
    solve_s: Array

    @property
    def times_s(self) -> Array:
        """(K + 1,) from 0."""
        times: Array = PAPER_STEP_S * np.arange(len(self.states), dtype=np.float64)
        return times

    @property
    def errors(self) -> Array:
        """e_u ... e_psi and mu_e (8,), Eqs. 31-32; psi in degrees, as in Tables 3 and 4."""
        off = (self.states - self.tracked)[1:, list(TRACKED)]
        off[:, -1] = np.degrees(off[:, -1])
        squares = np.sum(off**2, axis=0)
        return np.append(squares, squares.sum())

    @property
    def position_errors_m(self) -> Array:
        """Distance from the reference (K + 1,)."""
        distances: Array = np.linalg.norm((self.states - self.tracked)[:, X : Z + 1], axis=1)
        return distances


def fly(task: FlightTask) -> Flight:
    """Fly `task`; the same task gives the same flight, except for the solve times."""
    vehicle, settings, (dynamics, control_map) = paper_vehicle(), task.settings, paper_model()
    nonlinear, to_go = task.plant is PlantKind.NONLINEAR, task.law is LawName.COST_TO_GO
    plant = (NonlinearPlant if nonlinear else LinearPlant)(
        np.array(task.wind_ned_mps), task.thrust_loss
    )
    lower, upper = flyable_box(vehicle, settings) if nonlinear else (None, None)
    terminal = cost_to_go(settings) if to_go else None
    law = PaperLaw(dynamics, control_map, settings, lower, upper, terminal, seed=task.seed)
    exact = ExactMinimum(4)
    samples, tracked = sampled_path(task.path, task.steps)
    # What the model itself does as it follows the reference: the cost-to-go needs it
    consistent = (heading_states if nonlinear else linear_states)(samples, vehicle)
    nominal = nominal_inputs(consistent, samples, vehicle, nonlinear)
    state = tracked[0].copy()
    state[X : Z + 1] += task.start_offset_m
    if to_go:
        state[:PSI] = consistent[0][:PSI]
    states, inputs, quality = [state], [], []
    for k in range(task.steps):
        seen, target = _in_axes_of_the_law(state, tracked, samples, k + 1, nonlinear)
        if to_go:
            seen, _ = _in_axes_of_the_law(state, tracked, samples, k, nonlinear)
            target = dynamics @ consistent[k] + control_map @ nominal[k]
        started = monotonic_s()
        move = law.move(
            seen,
            target,
            error=(state - tracked[k])[list(INTEGRATED)],
            heading_rad=state[PSI] if nonlinear else 0.0,
            nominal=nominal[k] if to_go else None,
        )
        solve_s = monotonic_s() - started
        certificate = certify(move.problem, move.result, exact)
        quality.append((certificate.cost, certificate.spread, certificate.gap, solve_s))
        inputs.append(move.inputs)
        state = plant.next_state(state, move.inputs)
        states.append(state)
    flown, applied = np.array(states), np.array(inputs)
    if nonlinear:
        velocities = flown[:, EULER.velocity, None]
        flown[:, U : W + 1] = (_rotations(flown) @ velocities)[..., 0]
    changes = np.diff(applied, axis=0, prepend=0.0)
    signal_costs = applied**2 @ settings.energy + changes**2 @ settings.rate
    costs, *rest = np.array(quality).T
    return Flight(flown, tracked, applied, costs, signal_costs, *rest)


def _in_axes_of_the_law(
    state: Array, tracked: Array, samples: FlatSample, k: int, nonlinear: bool
) -> tuple[Array, Array]:
    """State and reference k (12,): unchanged on the linear plant; in the heading frame and
    relative to sample k on the nonlinear one."""
    if not nonlinear:
        return state, tracked[k]
    rotation, still = _rotations(state), np.zeros(3)
    predicted = PredictedState(
        0.0, state[X : Z + 1], rotation @ state[U : W + 1], rotation[:, 2], still,
        float(state[PSI]), 0.0, 0.0, still, state[P : R + 1],
    )  # fmt: skip
    parts = (getattr(samples, field.name) for field in fields(samples))
    return heading_frame(predicted, FlatSample(*(part[k] for part in parts)))


def _rotations(states: Array) -> Array:
    """Rotations (..., 3, 3) from the body to NED of states (..., 12)."""
    angles = np.moveaxis(states[..., EULER.attitude], -1, 0)
    return rotation_from_quaternion(quaternion_from_euler(*angles))


def cost_to_go(settings: PaperSettings) -> Array:
    """P (12, 12) of the infinite horizon (Riccati) with Q and R of `settings`."""
    import control  # takes a second: only where something is designed

    weights = np.diag(settings.fitness), np.diag(settings.energy)
    solution: Array = control.dlqr(*paper_model(), *weights)[1]
    return solution


class Flights:
    """The flights of one run of the study, each flown once; `on_flight` is called before each.

    first: the first configuration (section 4.1) at lambda = 1. seeds: flights per row of a table.
    """

    def __init__(
        self,
        first: PaperSettings | None = None,
        seeds: int = 1,
        quick: bool = False,
        on_flight: Callable[[], None] = lambda: None,
    ) -> None:
        self.first = first or PaperSettings.first_configuration()
        self.seeds, self.quick = seeds, quick
        self._on_flight = on_flight
        self._flown: dict[FlightTask, Flight] = {}

    def __call__(self, task: FlightTask) -> Flight:
        """The flight of `task`."""
        if task not in self._flown:
            self._on_flight()
            self._flown[task] = fly(task)
        return self._flown[task]

    def by_seed(
        self, settings: PaperSettings, plant: PlantKind = PlantKind.LINEAR, most: int = 10_000
    ) -> list[Flight]:
        """One flight on the path per seed, at most `most`."""
        count = min(self.seeds, most)
        return [self(FlightTask(settings, plant, seed=seed)) for seed in range(count)]

    def damped(self, damping: float, **swarm: float) -> PaperSettings:
        """The first configuration with this lambda, and other settings of the swarm."""
        changes = {"swarm": self.first.swarm.model_copy(update={"damping": damping, **swarm})}
        return self.first.model_copy(update=changes)
